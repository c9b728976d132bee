// MLS-MPM by hand for one processor's vectors: explicit steps, APIC, quadratic kernel, neo-Hookean. What it takes is a
// limit for other codes. `vectorised_mpm.py` compiles and calls it.
//
// The lanes of a vector are cells, mostly neighbours along the last axis (`sorted_cells.h`). What one particle of each
// gives to a node of its cell is then one vector, neither gathered nor turned, and such sums stay on the stack for all
// particles of these cells. They go to the grid once: cells that are neighbours give to nodes that are neighbours, so
// that whole vectors are added.
//
// One pass over the particles takes velocities from the nodes and gives momenta for the next step to them: x and F are
// read and written once a step, v and C are in registers only. Particles that have left their cells, strays, are done
// one by one; once they have cost about what sorting costs, all are sorted again. Each thread adds to a grid of its
// own, in which it notes how far each row of nodes is reached.

#include <algorithm>
#include <array>
#include <barrier>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

#include "sorted_cells.h"
#include "stencil.h"

namespace {

template <class N, class T>
INLINE N load(const T* from) {
  N found;
  std::memcpy(&found, from, sizeof found);
  return found;
}

template <class N, class T>
INLINE void store(T* to, N value) {
  std::memcpy(to, &value, sizeof value);
}

struct AnyBody {
  virtual ~AnyBody() = default;
  virtual void run(int steps, double dt, void* x, void* v, void* F) = 0;
};

template <class T, int d>
class Body : public AnyBody {
  static constexpr int lanes = 64 / sizeof(T), columns = d + 1, corners = power_of_three(d);
  using Whole = typename Lanes<T>::Whole;
  using Vector = typename Lanes<T>::Vector;
  using Mask = typename Lanes<T>::Mask;
  using Block = typename Cells<T, d>::Block;
  using Group = typename Cells<T, d>::Group;
  using Run = typename Cells<T, d>::Run;

  struct Motion {
    Vector v[d], C[d][d];
  };
  // The nodes of a row that are reached.
  struct Reach {
    int64_t low = INT64_MAX / 2, high = 0;
    void extend(Reach other) { low = std::min(low, other.low), high = std::max(high, other.high); }
  };

 public:
  Body(int64_t count, const int64_t* shape, double spacing, double shear_modulus, double lame_lambda,
       const double* gravity, const double* x, const double* v, double mass, double volume, int threads)
      : cells_(count, shape, spacing, x, mass, volume, threads), count_(count), rows_(1), spacing_(spacing),
        mu_(shear_modulus), lambda_(lame_lambda), threads_(threads), strays_(threads), reach_(threads), sums_(threads) {
    for (int a = 0; a < d; ++a) shape_[a] = shape[a], gravity_[a] = gravity[a];
    for (int a = 0; a < d - 1; ++a) rows_ *= shape[a];
    length_ = (shape_[d - 1] + lanes - 1) / lanes * lanes;
    for (auto& sums : sums_) sums.resize(rows_ * length_ * columns / lanes + 2);
    for (auto& reach : reach_) reach.resize(rows_);
    velocity_.resize(sums_[0].size());
    motions_.resize(cells_.blocks.size());
    for (int thread = 0; thread < threads; ++thread)
      cells_.each_place(thread, [&](const Group&, int64_t k, int l) {
        const int64_t p = cells_.names[k][l];
        for (int a = 0; a < d; ++a) motions_[k].v[a][l] = p < 0 ? 0 : v[p * d + a];
      });
  }

  void run(int steps, double dt, void* x, void* v, void* F) override {
    std::barrier<> together(threads_);
    auto work = [&](int thread) {
      for (int step = 0; step < steps; ++step) {
        if (step == 0)
          pass<false, true>(thread, dt);
        else
          pass<true, true>(thread, dt);
        together.arrive_and_wait();
        const bool many_strays = std::accumulate(strays_.begin(), strays_.end(), int64_t{0}) > count_ / 4;
        update_grid(thread, dt);
        if (many_strays) cells_.find_cells(thread);
        together.arrive_and_wait();
        if (!many_strays) continue;
        if (thread == 0) {
          cells_.sort();
          motions_.resize(cells_.blocks.size());
        }
        together.arrive_and_wait();
        cells_.rearrange(thread);
        strays_[thread] = 0;
      }
      if (steps > 0) pass<true, false>(thread, dt);
      write(thread, static_cast<T*>(x), static_cast<T*>(v), static_cast<T*>(F));
    };
    std::vector<std::thread> others;
    for (int thread = 1; thread < threads_; ++thread) others.emplace_back(work, thread);
    work(0);
    for (auto& other : others) other.join();
  }

 private:
  // ---- the grid ----

  // Where a number of a node is: each row has its columns one after the other.
  int64_t place_of(int64_t row, int64_t node, int column) const { return (row * columns + column) * length_ + node; }

  // Calls `visit` with the first corner in a row of a stencil, and the row.
  template <class Visit>
  INLINE void corner_rows(int64_t row, Visit visit) const {
    for (int i = 0; i < 3; ++i)
      if constexpr (d == 2)
        visit(3 * i, row + i);
      else
        for (int j = 0; j < 3; ++j) visit(3 * (3 * i + j), row + i * shape_[1] + j);
  }

  // The velocities around the cells of a run; in other lanes, unless the run is the first, they stay.
  template <bool first>
  INLINE void read(const Run& run, Vector (&nodes)[corners][d]) const {
    const T* velocity = numbers(velocity_);
    corner_rows(run.row, [&](int corner, int64_t row) {
      for (int c = 0; c < d; ++c)
        for (int s = 0; s < 3; ++s) {
          const auto found = load<Vector>(velocity + place_of(row, run.node + s, c));
          nodes[corner + s][c] = first ? found : run.mask ? found : nodes[corner + s][c];
        }
    });
  }

  // Adds what the cells of a run give. Of three nodes in a row the second is the third of the lane before: the vectors
  // are moved by a lane each, and added up before they are stored.
  INLINE void add(int thread, const Run& run, const Vector (&nodes)[corners][columns]) {
    T* sums = numbers(sums_[thread]);
    corner_rows(run.row, [&](int corner, int64_t row) {
      for (int c = 0; c < columns; ++c) {
        Vector given[3];
        for (int s = 0; s < 3; ++s) given[s] = run.mask ? nodes[corner + s][c] : Vector{};
        T* to = sums + place_of(row, run.node, c);
        store(to, load<Vector>(to) + given[0] + moved<1>(given[1], every_lane) + moved<2>(given[2], every_lane));
        to[lanes] += given[1][lanes - 1] + given[2][lanes - 2];
        to[lanes + 1] += given[2][lanes - 1];
      }
    });
    note(thread, run.row, run.node + run.begin, run.node + run.end + 2);
  }

  static constexpr std::make_integer_sequence<int, lanes> every_lane{};

  template <int by, int... lane>
  INLINE static Vector moved(Vector value, std::integer_sequence<int, lane...>) {
    return __builtin_shufflevector(value, Vector{}, (lane < by ? lanes : lane - by)...);
  }

  // Notes that nodes from a first one on, of the rows of a stencil, are reached.
  INLINE void note(int thread, int64_t row, int64_t low, int64_t high) {
    corner_rows(row, [&](int, int64_t at) { reach_[thread][at].extend({low, high}); });
  }

  // The row of a thread's first group; what comes before is the first thread's.
  int64_t first_row(int thread) const {
    const size_t group = cells_.first_groups[thread];
    return thread == 0 ? 0 : group < cells_.groups.size() ? cells_.runs[cells_.groups[group].first_run].row : rows_;
  }

  // The velocities of a thread's rows; sums are cleared.
  void update_grid(int thread, T dt) {
    T* velocity = numbers(velocity_);
    for (int64_t row = first_row(thread); row < first_row(thread + 1); ++row) {
      Reach all;
      for (const auto& reach : reach_) all.extend(reach[row]);
      for (int64_t node = all.low / lanes * lanes; node < all.high; node += lanes) {
        Vector sum[columns] = {};
        for (int other = 0; other < threads_; ++other) {
          if (reach_[other][row].high == 0) continue;
          for (int c = 0; c < columns; ++c) {
            T* from = numbers(sums_[other]) + place_of(row, node, c);
            sum[c] += load<Vector>(from);
            store(from, Vector{});
          }
        }
        for (int c = 0; c < d; ++c)
          store(velocity + place_of(row, node, c), sum[d] > 0 ? sum[c] / sum[d] + dt * gravity_[c] : Vector{});
      }
      for (auto& reach : reach_) reach[row] = {};
    }
  }

  // ---- the particles ----

  // Stencils of a block. Returns which of its particles are strays.
  INLINE Mask find_stencils(const Block& block, const Group& group, Stencil<Vector, T, d>& at) const {
    Mask outside{};
    for (int a = 0; a < d; ++a) {
      at.find(a, block.x[a] * (1 / spacing_) - group.middle[a]);
      outside |= (at.place[a] > T(0.5)) | (at.place[a] < T(-0.5));
    }
    return outside & (block.mass > 0);
  }

  // Calls `visit` with the lane of each stray, its stencil, and its first node's row and place in it.
  template <class Visit>
  INLINE void visit_strays(const Block& block, Mask stray, Visit visit) const {
    Whole found = 0, each[lanes];
    store(each, stray);
    for (int l = 0; l < lanes; ++l) found |= each[l];
    if (!found) [[likely]] return;
    for (int l = 0; l < lanes; ++l) {
      if (!stray[l]) continue;
      Stencil<T, T, d> at;
      int64_t row = 0, node = 0;
      for (int a = 0; a < d; ++a) {
        const T place = block.x[a][l] * (1 / spacing_);
        node = static_cast<int64_t>(place - T(0.5));
        at.find(a, place - node - 1);
        if (a < d - 1) row = row * shape_[a] + node;
      }
      visit(l, at, row, node);
    }
  }

  template <class N>
  INLINE static void velocities(const Stencil<N, T, d>& at, const N (&nodes)[corners][d], N (&v)[d], N (&slope)[d][d]) {
    for (int r = 0; r < d; ++r) {
      const auto found = at.template take<d>(&nodes[0][r], d);
      v[r] = found[0];
      for (int c = 0; c < d; ++c) slope[r][c] = found[d - c] - at.place[c] * found[0];
    }
  }

  template <class N>
  INLINE static void momenta(const Stencil<N, T, d>& at, N mass, const N (&momentum)[d], const N (&affine)[d][d],
                             N (&nodes)[corners][columns]) {
    for (int r = 0; r < d; ++r) {
      std::array<N, d + 1> given{momentum[r]};
      for (int c = 0; c < d; ++c) given[d - c] = affine[r][c], given[0] -= at.place[c] * affine[r][c];
      at.template give<d>(&nodes[0][r], columns, given);
    }
    at.template give<d>(&nodes[0][d], columns, {mass});
  }

  // Takes from the nodes and moves the particles, or gives to the nodes, or does both.
  template <bool takes, bool gives>
  void pass(int thread, T dt) {
    for (int64_t g = cells_.first_groups[thread]; g < cells_.first_groups[thread + 1]; ++g) {
      const Group& group = cells_.groups[g];
      Vector nodes[corners][d], sums[corners][columns] = {};
      if constexpr (takes) {
        read<true>(cells_.runs[group.first_run], nodes);
        for (int r = group.first_run + 1; r < group.last_run; ++r) read<false>(cells_.runs[r], nodes);
      }
      for (int64_t k = group.begin; k < group.end; ++k) {
        Block& block = cells_.blocks[k];
        for (size_t line = 0; line < sizeof(Block); line += 64)
          __builtin_prefetch(reinterpret_cast<const char*>(&block + 2) + line, 1);
        Motion motion;
        if constexpr (takes)
          move(block, group, nodes, motion, dt);
        else
          motion = motions_[k];
        if constexpr (gives)
          give(thread, block, group, motion, sums, dt);
        else
          motions_[k] = motion;
      }
      if constexpr (gives)
        for (int r = group.first_run; r < group.last_run; ++r) add(thread, cells_.runs[r], sums);
    }
  }

  // G2P, and the particles' update.
  INLINE void move(Block& block, const Group& group, const Vector (&nodes)[corners][d], Motion& motion, T dt) const {
    Stencil<Vector, T, d> at;
    const Mask stray = find_stencils(block, group, at);
    velocities(at, nodes, motion.v, motion.C);
    visit_strays(block, stray, [&](int l, const Stencil<T, T, d>& one, int64_t row, int64_t node) {
      T around[corners][d], v[d], slope[d][d];
      corner_rows(row, [&](int corner, int64_t at) {
        for (int s = 0; s < 3; ++s)
          for (int c = 0; c < d; ++c) around[corner + s][c] = numbers(velocity_)[place_of(at, node + s, c)];
      });
      velocities(one, around, v, slope);
      for (int r = 0; r < d; ++r) {
        motion.v[r][l] = v[r];
        for (int c = 0; c < d; ++c) motion.C[r][c][l] = slope[r][c];
      }
    });
    const Vector moving = block.mass > 0 ? Vector{} + dt : Vector{};
    for (int r = 0; r < d; ++r) {
      block.x[r] += moving * motion.v[r];
      for (int c = 0; c < d; ++c) motion.C[r][c] *= 4 / spacing_;
    }
    for (int c = 0; c < d; ++c) {
      Vector column[d];
      for (int s = 0; s < d; ++s) column[s] = block.F[s][c];
      for (int r = 0; r < d; ++r) {
        Vector change{};
        for (int s = 0; s < d; ++s) change += motion.C[r][s] * column[s];
        block.F[r][c] += moving * change;
      }
    }
  }

  // P2G of mass, momentum and the force's impulse at once.
  INLINE void give(int thread, const Block& block, const Group& group, const Motion& motion,
                   Vector (&nodes)[corners][columns], T dt) {
    const auto& F = block.F;
    const Vector scale = -4 * dt / spacing_ * block.volume;
    Vector J;
    if constexpr (d == 2)
      J = F[0][0] * F[1][1] - F[0][1] * F[1][0];
    else
      J = F[0][0] * (F[1][1] * F[2][2] - F[1][2] * F[2][1]) - F[0][1] * (F[1][0] * F[2][2] - F[1][2] * F[2][0]) +
          F[0][2] * (F[1][0] * F[2][1] - F[1][1] * F[2][0]);
    T logarithms[lanes];
    store(logarithms, J);
    for (auto& number : logarithms) number = std::log(number);
    const Vector pressure = lambda_ * load<Vector>(logarithms) - mu_;
    Vector momentum[d], affine[d][d];
    for (int r = 0; r < d; ++r) {
      momentum[r] = block.mass * motion.v[r];
      for (int c = 0; c < d; ++c) {
        Vector b{};
        for (int s = 0; s < d; ++s) b += F[r][s] * F[c][s];
        affine[r][c] = spacing_ * block.mass * motion.C[r][c] + scale * (mu_ * b + (r == c ? pressure : Vector{}));
      }
    }
    Stencil<Vector, T, d> at;
    const Mask stray = find_stencils(block, group, at);
    visit_strays(block, stray, [&](int l, const Stencil<T, T, d>& one, int64_t row, int64_t node) {
      T around[corners][columns] = {}, q[d], slope[d][d];
      for (int r = 0; r < d; ++r) {
        q[r] = momentum[r][l];
        for (int c = 0; c < d; ++c) slope[r][c] = affine[r][c][l];
      }
      momenta<T>(one, block.mass[l], q, slope, around);
      corner_rows(row, [&](int corner, int64_t at) {
        for (int s = 0; s < 3; ++s)
          for (int c = 0; c < columns; ++c) numbers(sums_[thread])[place_of(at, node + s, c)] += around[corner + s][c];
      });
      note(thread, row, node, node + 3);
      ++strays_[thread];
    });
    for (auto& weight : at.weight[0]) weight = stray ? Vector{} : weight;
    momenta<Vector>(at, block.mass, momentum, affine, nodes);
  }

  void write(int thread, T* x, T* v, T* F) const {
    cells_.each_place(thread, [&](const Group&, int64_t k, int l) {
      const int64_t p = cells_.names[k][l];
      if (p < 0) return;
      for (int a = 0; a < d; ++a) {
        x[p * d + a] = cells_.blocks[k].x[a][l];
        v[p * d + a] = motions_[k].v[a][l];
        for (int b = 0; b < d; ++b) F[(p * d + a) * d + b] = cells_.blocks[k].F[a][b][l];
      }
    });
  }

  // The numbers of a grid; a vector before them and one after them are never nodes.
  static T* numbers(std::vector<Vector>& grid) { return reinterpret_cast<T*>(grid.data() + 1); }
  static const T* numbers(const std::vector<Vector>& grid) { return reinterpret_cast<const T*>(grid.data() + 1); }

  Cells<T, d> cells_;
  int64_t count_, shape_[d], rows_, length_;
  T spacing_, mu_, lambda_, gravity_[d];
  int threads_;
  std::vector<Motion> motions_;
  std::vector<int64_t> strays_;
  std::vector<std::vector<Reach>> reach_;  // of each row, for each thread
  std::vector<std::vector<Vector>> sums_;
  std::vector<Vector> velocity_;
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

void run(void* body, int steps, double dt, void* x, void* v, void* F) {
  static_cast<AnyBody*>(body)->run(steps, dt, x, v, F);
}

void end(void* body) { delete static_cast<AnyBody*>(body); }
}
