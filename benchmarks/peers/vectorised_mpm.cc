// MLS-MPM by hand for one processor's vectors: explicit steps, APIC, quadratic kernel, neo-Hookean. What it takes is a
// limit for other codes. `vectorised_mpm.py` compiles and calls it.
//
// Particles are sorted by cell once a call and kept in blocks of 16, component by component: stress and update are
// loops over the 16. Nodes have four numbers, of which the mass is the last, so that the three nodes of a stencil's row
// along the last axis are twelve lanes of one vector. Each thread has blocks of its own and adds to a grid of its own,
// of which it touches the slabs that its particles reach; the update of the nodes adds the grids up.

#include <algorithm>
#include <barrier>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <thread>
#include <utility>
#include <vector>

namespace {

constexpr int lanes = 16, columns = 4, mass_column = 3;

template <class T>
struct Vectors {
  typedef T Four __attribute__((vector_size(columns * sizeof(T))));
  typedef T Row __attribute__((vector_size(lanes * sizeof(T))));
};
template <class T>
using Four = typename Vectors<T>::Four;
template <class T>
using Row = typename Vectors<T>::Row;

template <class V, class T>
V load(const T* from) {
  V found;
  std::memcpy(&found, from, sizeof found);
  return found;
}

template <class V, class T>
void store(T* to, V value) {
  std::memcpy(to, &value, sizeof value);
}

// One number for each of the three nodes of a row, zero beyond them.
template <class T>
Row<T> by_node(T a, T b, T c) {
  return Row<T>{a, a, a, a, b, b, b, b, c, c, c, c, 0, 0, 0, 0};
}

// The same columns at each node of a row.
template <class T>
Row<T> at_each(const T* four) {
  auto one = load<Four<T>>(four);
  return __builtin_shufflevector(one, one, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
}

template <class T>
Four<T> sum_of_nodes(Row<T> row) {
  return __builtin_shufflevector(row, row, 0, 1, 2, 3) + __builtin_shufflevector(row, row, 4, 5, 6, 7) +
         __builtin_shufflevector(row, row, 8, 9, 10, 11);
}

// Sixteen particles; those that fill the last block up have no mass and no volume.
template <class T, int d>
struct alignas(64) Block {
  T x[d][lanes], v[d][lanes], C[d][d][lanes], F[d][d][lanes], mass[lanes], volume[lanes];
  int64_t from[lanes];  // the user's number of each, -1 of what fills up
};

// The stencils of a block: the first node, and along each axis the weights and the arms in spacings.
template <class T, int d>
struct Stencils {
  int64_t first[lanes];
  T weight[d][3][lanes], arm[d][3][lanes];
};

struct AnyBody {
  virtual ~AnyBody() = default;
  virtual void run(int steps, double dt, double* x, double* v, double* F) = 0;
};

template <class T, int d>
class Body : public AnyBody {
 public:
  Body(int64_t count, const int64_t* shape, double spacing, double shear_modulus, double lame_lambda,
       const double* gravity, const double* x, const double* v, double mass, double volume, int threads)
      : count_(count), spacing_(spacing), mu_(shear_modulus), lambda_(lame_lambda), threads_(threads),
        blocks_((count + lanes - 1) / lanes), reach_(threads), sums_(threads) {
    nodes_ = 1;
    for (int a = 0; a < d; ++a) shape_[a] = shape[a], gravity_[a] = gravity[a], nodes_ *= shape[a];
    slab_ = nodes_ / shape_[0] * columns;
    for (auto& sums : sums_) sums.resize(nodes_ * columns + lanes);
    velocity_.resize(nodes_ * columns + lanes);
    for (int64_t p = 0; p < static_cast<int64_t>(blocks_.size()) * lanes; ++p) {
      Block<T, d>& block = blocks_[p / lanes];
      const int64_t l = p % lanes, q = std::min(p, count - 1);
      block.from[l] = p < count ? p : -1;
      block.mass[l] = p < count ? mass : 0;
      block.volume[l] = p < count ? volume : 0;
      for (int a = 0; a < d; ++a) {
        block.x[a][l] = x[q * d + a];
        block.v[a][l] = v[q * d + a];
        for (int b = 0; b < d; ++b) block.C[a][b][l] = 0, block.F[a][b][l] = a == b;
      }
    }
  }

  void run(int steps, double dt, double* x, double* v, double* F) override {
    sort();
    std::barrier<> together(threads_);
    std::vector<std::thread> others;
    auto work = [&](int thread) {
      find_reach(thread);
      for (int step = 0; step < steps; ++step) {
        to_grid(thread, dt);
        together.arrive_and_wait();
        update_grid(thread, dt);
        together.arrive_and_wait();
        from_grid(thread, dt);
      }
    };
    for (int thread = 1; thread < threads_; ++thread) others.emplace_back(work, thread);
    work(0);
    for (auto& other : others) other.join();
    for (const auto& block : blocks_)
      for (int l = 0; l < lanes; ++l) {
        const int64_t p = block.from[l];
        if (p < 0) continue;
        for (int a = 0; a < d; ++a) {
          x[p * d + a] = block.x[a][l];
          v[p * d + a] = block.v[a][l];
          for (int b = 0; b < d; ++b) F[(p * d + a) * d + b] = block.F[a][b][l];
        }
      }
  }

 private:
  // The blocks of a thread.
  std::pair<int64_t, int64_t> share(int thread) const {
    const int64_t n = blocks_.size();
    return {n * thread / threads_, n * (thread + 1) / threads_};
  }

  int64_t first_node(const Block<T, d>& block, int l) const {
    int64_t node = 0;
    for (int a = 0; a < d; ++a) node = node * shape_[a] + static_cast<int64_t>(block.x[a][l] / spacing_ - T(0.5));
    return node;
  }

  // A counting sort by the first node; what fills up stays at the end.
  void sort() {
    std::vector<int64_t> begins(nodes_ + 2), keys(blocks_.size() * lanes, nodes_);
    for (size_t k = 0; k < keys.size(); ++k) {
      const auto& block = blocks_[k / lanes];
      if (block.from[k % lanes] >= 0) keys[k] = first_node(block, k % lanes);
      ++begins[keys[k] + 1];
    }
    for (int64_t node = 0; node <= nodes_; ++node) begins[node + 1] += begins[node];
    std::vector<Block<T, d>> sorted(blocks_.size());
    for (size_t k = 0; k < keys.size(); ++k) {
      const int64_t to = begins[keys[k]]++;
      const T* one = blocks_[k / lanes].x[0] + k % lanes;
      T* other = sorted[to / lanes].x[0] + to % lanes;
      for (int number = 0; number < numbers; ++number) other[number * lanes] = one[number * lanes];
      sorted[to / lanes].from[to % lanes] = blocks_[k / lanes].from[k % lanes];
    }
    blocks_.swap(sorted);
  }

  // The first and the last slab of nodes, across the first axis, that a thread's particles reach.
  void find_reach(int thread) {
    const auto [begin, end] = share(thread);
    T low = shape_[0] * spacing_, high = 0;
    for (int64_t k = begin; k < end; ++k)
      for (int l = 0; l < lanes; ++l) {
        low = std::min(low, blocks_[k].x[0][l]);
        high = std::max(high, blocks_[k].x[0][l]);
      }
    const auto first = [&](T x) { return static_cast<int64_t>(x / spacing_ - T(0.5)); };
    reach_[thread] = {first(low), first(high) + 2};
  }

  void find_stencils(const Block<T, d>& block, Stencils<T, d>& at) const {
    const T inverse = 1 / spacing_;
    for (int l = 0; l < lanes; ++l) at.first[l] = 0;
    for (int a = 0; a < d; ++a)
      for (int l = 0; l < lanes; ++l) {
        const T place = block.x[a][l] * inverse;
        const auto node = static_cast<int32_t>(place - T(0.5));
        const T f = place - node;
        at.first[l] = at.first[l] * shape_[a] + node;
        at.weight[a][0][l] = T(0.5) * (T(1.5) - f) * (T(1.5) - f);
        at.weight[a][1][l] = T(0.75) - (f - 1) * (f - 1);
        at.weight[a][2][l] = T(0.5) * (f - T(0.5)) * (f - T(0.5));
        for (int s = 0; s < 3; ++s) at.arm[a][s][l] = s - f;
      }
  }

  // Calls `visit` with the offset, the weight and the arms of each row of a particle's stencil.
  template <class Visit>
  void rows(const Stencils<T, d>& at, int l, Visit visit) const {
    for (int i = 0; i < 3; ++i) {
      const T weight = at.weight[0][i][l], arm = at.arm[0][i][l];
      if constexpr (d == 2) {
        visit((at.first[l] + i * shape_[1]) * columns, weight, arm, T(0));
      } else {
        for (int j = 0; j < 3; ++j)
          visit((at.first[l] + (i * shape_[1] + j) * shape_[2]) * columns, weight * at.weight[1][j][l], arm,
                at.arm[1][j][l]);
      }
    }
  }

  static Row<T> last_axis(const T (&values)[d][3][lanes], int l) {
    return by_node<T>(values[d - 1][0][l], values[d - 1][1][l], values[d - 1][2][l]);
  }

  // P2G of mass, momentum and the force's impulse at once.
  void to_grid(int thread, T dt) {
    const auto [low, high] = reach_[thread];
    T* sums = sums_[thread].data();
    std::fill(sums + low * slab_, sums + (high + 1) * slab_, T(0));
    const auto [begin, end] = share(thread);
    Stencils<T, d> at;
    alignas(64) T momentum[lanes][columns] = {}, affine[d][lanes][columns] = {};
    for (int64_t k = begin; k < end; ++k) {
      const Block<T, d>& block = blocks_[k];
      find_stencils(block, at);
      for (int l = 0; l < lanes; ++l) {
        const T m = block.mass[l], scale = -4 * dt * block.volume[l] / spacing_;
        T b[d][d], J;
        for (int r = 0; r < d; ++r)
          for (int c = 0; c < d; ++c) {
            b[r][c] = 0;
            for (int s = 0; s < d; ++s) b[r][c] += block.F[r][s][l] * block.F[c][s][l];
          }
        auto F = [&](int r, int c) { return block.F[r][c][l]; };
        if constexpr (d == 2)
          J = F(0, 0) * F(1, 1) - F(0, 1) * F(1, 0);
        else
          J = F(0, 0) * (F(1, 1) * F(2, 2) - F(1, 2) * F(2, 1)) - F(0, 1) * (F(1, 0) * F(2, 2) - F(1, 2) * F(2, 0)) +
              F(0, 2) * (F(1, 0) * F(2, 1) - F(1, 1) * F(2, 0));
        const T pressure = lambda_ * std::log(J) - mu_;
        for (int r = 0; r < d; ++r) {
          momentum[l][r] = m * block.v[r][l];
          for (int c = 0; c < d; ++c)
            affine[c][l][r] = m * spacing_ * block.C[r][c][l] + scale * (mu_ * b[r][c] + (r == c ? pressure : T(0)));
        }
        momentum[l][mass_column] = m;
      }
      for (int l = 0; l < lanes; ++l) {
        const Row<T> weights = last_axis(at.weight, l), arms = last_axis(at.arm, l);
        const Row<T> even = weights * (at_each(momentum[l]) + arms * at_each(affine[d - 1][l]));
        const Row<T> by_first = weights * at_each(affine[0][l]);
        const Row<T> by_second = weights * at_each(affine[d - 2][l]);
        rows(at, l, [&](int64_t offset, T weight, T first, T second) {
          Row<T> added = even + first * by_first;
          if constexpr (d == 3) added += second * by_second;
          store(sums + offset, load<Row<T>>(sums + offset) + weight * added);
        });
      }
    }
  }

  // The velocities of the nodes, of a share of the slabs.
  void update_grid(int thread, T dt) {
    int64_t low = shape_[0], high = -1;
    for (const auto& reach : reach_) low = std::min(low, reach.first), high = std::max(high, reach.second);
    const int64_t slabs = high + 1 - low;
    Row<T> gravity{};
    for (int c = 0; c < lanes; ++c) gravity[c] = c % columns < d ? gravity_[c % columns] : T(0);
    for (int64_t s = low + slabs * thread / threads_; s < low + slabs * (thread + 1) / threads_; ++s)
      for (int64_t at = s * slab_; at < (s + 1) * slab_; at += lanes) {
        Row<T> sum{};
        for (int other = 0; other < threads_; ++other)
          if (reach_[other].first <= s && s <= reach_[other].second) sum += load<Row<T>>(sums_[other].data() + at);
        const Row<T> mass = __builtin_shufflevector(sum, sum, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
        store(velocity_.data() + at, mass > 0 ? sum / mass + dt * gravity : Row<T>{});
      }
  }

  // G2P, and the particles' update.
  void from_grid(int thread, T dt) {
    const auto [begin, end] = share(thread);
    const T* velocity = velocity_.data();
    Stencils<T, d> at;
    alignas(64) T mean[lanes][columns], slope[d][lanes][columns];
    for (int64_t k = begin; k < end; ++k) {
      Block<T, d>& block = blocks_[k];
      find_stencils(block, at);
      for (int l = 0; l < lanes; ++l) {
        Row<T> even{}, by_first{}, by_second{};
        rows(at, l, [&](int64_t offset, T weight, T first, T second) {
          const Row<T> row = weight * load<Row<T>>(velocity + offset);
          even += row;
          by_first += first * row;
          if constexpr (d == 3) by_second += second * row;
        });
        const Row<T> weights = last_axis(at.weight, l), arms = last_axis(at.arm, l);
        store(mean[l], sum_of_nodes<T>(weights * even));
        store(slope[0][l], sum_of_nodes<T>(weights * by_first));
        if constexpr (d == 3) store(slope[1][l], sum_of_nodes<T>(weights * by_second));
        store(slope[d - 1][l], sum_of_nodes<T>(weights * arms * even));
      }
      for (int l = 0; l < lanes; ++l) {
        T C[d][d], F[d][d];
        for (int r = 0; r < d; ++r) {
          block.v[r][l] = mean[l][r];
          block.x[r][l] += dt * mean[l][r];
          for (int c = 0; c < d; ++c) C[r][c] = 4 / spacing_ * slope[c][l][r], F[r][c] = block.F[r][c][l];
        }
        for (int r = 0; r < d; ++r)
          for (int c = 0; c < d; ++c) {
            T change = 0;
            for (int s = 0; s < d; ++s) change += C[r][s] * F[s][c];
            block.C[r][c][l] = C[r][c];
            block.F[r][c][l] = F[r][c] + dt * change;
          }
      }
    }
    find_reach(thread);
  }

  static constexpr int numbers = 2 * d + 2 * d * d + 2;  // of a particle: x, v, C, F, mass, volume
  int64_t count_, nodes_, slab_, shape_[d];
  T spacing_, mu_, lambda_, gravity_[d];
  int threads_;
  std::vector<Block<T, d>> blocks_;
  std::vector<std::pair<int64_t, int64_t>> reach_;
  std::vector<std::vector<T>> sums_;
  std::vector<T> velocity_;
};

}  // namespace

extern "C" {

void* begin(int d, int bytes, int64_t count, const int64_t* shape, double spacing, double shear_modulus,
            double lame_lambda, const double* gravity, const double* x, const double* v, double mass, double volume,
            int threads) {
  auto make = [&](auto number, auto dimension) -> AnyBody* {
    return new Body<decltype(number), dimension()>(count, shape, spacing, shear_modulus, lame_lambda, gravity, x, v,
                                                   mass, volume, threads);
  };
  std::integral_constant<int, 2> two;
  std::integral_constant<int, 3> three;
  if (bytes == 4) return d == 2 ? make(0.0f, two) : make(0.0f, three);
  return d == 2 ? make(0.0, two) : make(0.0, three);
}

void run(void* body, int steps, double dt, double* x, double* v, double* F) {
  static_cast<AnyBody*>(body)->run(steps, dt, x, v, F);
}

void end(void* body) { delete static_cast<AnyBody*>(body); }
}
