// MLS-MPM by hand for one processor's vectors: explicit steps, APIC, quadratic kernel, neo-Hookean. What it takes is a
// limit for other codes. `vectorised_mpm.py` compiles and calls it.
//
// The lanes of a vector are cells, those of particles with the same first node, mostly neighbours along the last axis; a
// block has one particle of each. What these give to a node of their cells is then one vector, neither gathered nor
// turned, and stays on the stack for all blocks of a group. It goes to the grid once a group: cells that are neighbours
// give to nodes that are neighbours, so that whole vectors are added.
//
// One pass over the particles takes velocities from the nodes and gives momenta for the next step to them: x and F are
// read and written once a step, v and C are in registers only. Particles that have left their cells, strays, are done
// one by one; once they have cost about what sorting costs, all are sorted again. Each thread has groups of its own and
// adds to a grid of its own, in which it notes how far each row of nodes is reached.

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

namespace {

#define INLINE [[gnu::always_inline]] inline

constexpr int power_of_three(int n) { return n == 0 ? 1 : 3 * power_of_three(n - 1); }

template <class T>
struct Lanes {
  typedef std::conditional_t<sizeof(T) == 4, int32_t, int64_t> Whole;
  typedef T Vector __attribute__((vector_size(64)));
  typedef Whole Mask __attribute__((vector_size(64)));
};

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

// The weights of a stencil along each axis, and where the particle is from the middle node, in spacings. N is a number,
// or a vector of them.
template <class N, class T, int d>
struct Stencil {
  N place[d], weight[d][3];

  INLINE void find(int axis, N at) {
    place[axis] = at;
    weight[axis][0] = T(0.5) * (T(0.5) - at) * (T(0.5) - at);
    weight[axis][1] = T(0.75) - at * at;
    weight[axis][2] = T(0.5) * (at + T(0.5)) * (at + T(0.5));
  }

  // The mean along the last n axes of what the nodes have, and its slopes, the last axis first: the sums of weights
  // times places of nodes from the middle node.
  template <int n>
  INLINE std::array<N, n + 1> take(const N* nodes, int step) const {
    if constexpr (n == 0) {
      return {*nodes};
    } else {
      const N* w = weight[d - n];
      const int across = power_of_three(n - 1) * step;
      const auto low = take<n - 1>(nodes, step), middle = take<n - 1>(nodes + across, step),
                 high = take<n - 1>(nodes + 2 * across, step);
      std::array<N, n + 1> found;
      for (int k = 0; k < n; ++k) found[k] = w[0] * low[k] + w[1] * middle[k] + w[2] * high[k];
      found[n] = w[2] * high[0] - w[0] * low[0];
      return found;
    }
  }

  // The transpose: adds to the nodes.
  template <int n>
  INLINE void give(N* nodes, int step, const std::array<N, n + 1>& given) const {
    if constexpr (n == 0) {
      *nodes += given[0];
    } else {
      const N* w = weight[d - n];
      for (int s = 0; s < 3; ++s) {
        std::array<N, n> part;
        for (int k = 0; k < n; ++k) part[k] = w[s] * given[k];
        if (s != 1) part[0] += T(s - 1) * w[s] * given[n];
        give<n - 1>(nodes + s * power_of_three(n - 1) * step, step, part);
      }
    }
  }
};

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
  using Name = std::array<int32_t, lanes>;  // the user's number of each particle, -1 of none

  // One particle of each cell of a group; where a cell has no more of them, one without mass and volume.
  struct Block {
    Vector x[d], F[d][d], mass, volume;
  };
  struct Motion {
    Vector v[d], C[d][d];
  };
  // Lanes whose cells are neighbours: those of a mask, and where in the grid the first node of lane 0 would be.
  struct Run {
    int64_t row, node;  // the row, and the node's place along it
    int begin, end;
    Mask mask;
  };
  struct Group {
    int64_t begin, end;  // blocks
    int first_run, last_run;
    Vector middle[d];  // the middle node of each cell
  };
  // The nodes of a row that are reached.
  struct Reach {
    int64_t low = INT64_MAX / 2, high = 0;
    void extend(Reach other) { low = std::min(low, other.low), high = std::max(high, other.high); }
  };

 public:
  Body(int64_t count, const int64_t* shape, double spacing, double shear_modulus, double lame_lambda,
       const double* gravity, const double* x, const double* v, double mass, double volume, int threads)
      : count_(count), spacing_(spacing), mu_(shear_modulus), lambda_(lame_lambda), threads_(threads),
        blocks_((count + lanes - 1) / lanes), names_(blocks_.size()), first_groups_(threads + 1), first_rows_(threads + 1),
        strays_(threads), reach_(threads), sums_(threads), rows_(1) {
    for (int a = 0; a < d; ++a) shape_[a] = shape[a], gravity_[a] = gravity[a];
    for (int a = 0; a < d - 1; ++a) rows_ *= shape[a];
    length_ = (shape_[d - 1] + lanes - 1) / lanes * lanes;
    for (auto& sums : sums_) sums.resize(rows_ * length_ * columns / lanes + 2);
    for (auto& reach : reach_) reach.resize(rows_);
    velocity_.resize(sums_[0].size());
    for (int64_t p = 0; p < static_cast<int64_t>(blocks_.size()) * lanes; ++p) {
      Block& block = blocks_[p / lanes];
      const int64_t l = p % lanes, q = std::min(p, count - 1);
      names_[p / lanes][l] = p < count ? p : -1;
      block.mass[l] = mass, block.volume[l] = volume;
      for (int a = 0; a < d; ++a) {
        block.x[a][l] = x[q * d + a];
        for (int b = 0; b < d; ++b) block.F[a][b][l] = a == b;
      }
    }
    cells_.resize(blocks_.size() * lanes);
    for (int thread = 0; thread < threads; ++thread) find_cells(thread);
    sort();
    for (int thread = 0; thread < threads; ++thread) rearrange(thread);
    for (size_t k = 0; k < names_.size(); ++k)
      for (int l = 0; l < lanes; ++l)
        for (int a = 0; a < d; ++a) motions_[k].v[a][l] = names_[k][l] < 0 ? 0 : v[names_[k][l] * d + a];
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
        if (many_strays) find_cells(thread);
        together.arrive_and_wait();
        if (!many_strays) continue;
        if (thread == 0) sort();
        together.arrive_and_wait();
        rearrange(thread);
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
  // ---- sorting ----

  // The cell of each particle of a thread's, -1 of none.
  void find_cells(int thread) {
    const int64_t blocks = blocks_.size();
    for (int64_t k = blocks * thread / threads_; k < blocks * (thread + 1) / threads_; ++k)
      for (int l = 0; l < lanes; ++l) {
        int64_t cell = 0;
        for (int a = 0; a < d; ++a)
          cell = cell * shape_[a] + static_cast<int32_t>(blocks_[k].x[a][l] * (1 / spacing_) - T(0.5));
        cells_[k * lanes + l] = names_[k][l] < 0 ? -1 : cell;
      }
  }

  // Groups of cells, with the present place of each particle in `order_`, -1 for none.
  void sort() {
    blocks_.swap(old_blocks_);
    names_.swap(old_names_);
    const int64_t nodes = rows_ * shape_[d - 1];
    std::vector<int32_t> begins(nodes + 2), listed(count_);
    for (auto cell : cells_)
      if (cell >= 0) ++begins[cell + 2];
    for (int64_t cell = 0; cell < nodes; ++cell) begins[cell + 2] += begins[cell + 1];
    for (size_t p = 0; p < cells_.size(); ++p)
      if (cells_[p] >= 0) listed[begins[cells_[p] + 1]++] = p;

    const int64_t depth = lane_depth(begins);
    groups_.clear(), runs_.clear(), order_.clear();
    int lane = lanes;
    auto add_lane = [&](int64_t row, int64_t node, int64_t begin, int64_t end) {
      if (lane == lanes) {
        const int64_t block = order_.size() / lanes;
        groups_.push_back(Group{block, block, static_cast<int>(runs_.size()), 0, {}});
        lane = 0;
      }
      if (lane == 0 || runs_.back().row != row || runs_.back().node + lane != node)
        runs_.push_back(Run{row, node - lane, lane, lane, Mask{}});
      runs_.back().mask[lane] = -1;
      runs_.back().end = lane + 1;
      Group& group = groups_.back();
      group.last_run = runs_.size();
      group.middle[d - 1][lane] = node + 1;
      for (int a = d - 2; a >= 0; row /= shape_[a--]) group.middle[a][lane] = row % shape_[a] + 1;
      group.end = std::max(group.end, group.begin + end - begin);
      order_.resize(group.end * lanes, -1);
      for (int64_t k = 0; k < end - begin; ++k) order_[(group.begin + k) * lanes + lane] = listed[begin + k];
      ++lane;
    };
    for (int64_t row = 0; row < rows_; ++row) {
      const int32_t* begin = begins.data() + row * shape_[d - 1];
      int64_t fullest = 0;
      for (int64_t node = 0; node < shape_[d - 1]; ++node)
        fullest = std::max<int64_t>(fullest, begin[node + 1] - begin[node]);
      for (int64_t part = 0; part < fullest; part += depth)
        for (int64_t node = 0; node < shape_[d - 1]; ++node)
          if (const int64_t from = begin[node] + part; from < begin[node + 1])
            add_lane(row, node, from, std::min<int64_t>(from + depth, begin[node + 1]));
    }
    names_.resize(order_.size() / lanes), blocks_.resize(names_.size()), motions_.resize(names_.size()), cells_.resize(order_.size());
    const int64_t blocks = blocks_.size(), groups = groups_.size();
    for (int64_t thread = 1, group = 0; thread < threads_; ++thread) {  // about as many blocks each
      while (group < groups && groups_[group].begin * threads_ < blocks * thread) ++group;
      first_groups_[thread] = group;
      first_rows_[thread] = group < groups ? runs_[groups_[group].first_run].row : rows_;
    }
    first_groups_[threads_] = groups, first_rows_[threads_] = rows_;
  }

  // How many of a cell's particles a lane takes at most, so that all lanes together are shortest. A lane costs as much
  // as one particle more, and one that splits a cell, for the run that it begins, as much as eight.
  static int64_t lane_depth(const std::vector<int32_t>& begins) {
    constexpr int64_t most = 64;
    std::array<int64_t, most + 1> cells{}, costs{INT64_MAX};  // how many cells have so many particles
    for (size_t cell = 0; cell + 1 < begins.size(); ++cell)
      ++cells[std::min<int64_t>(begins[cell + 1] - begins[cell], most)];
    for (int64_t depth = 1; depth <= most; ++depth)
      for (int64_t number = 1; number <= most; ++number)
        costs[depth] += cells[number] * ((number + depth - 1) / depth * (depth + 1 + 8) - 8);
    return std::min_element(costs.begin(), costs.end()) - costs.begin();
  }

  // Calls `visit` with the group, the block and the lane of each of a thread's places.
  template <class Visit>
  void each_place(int thread, Visit visit) const {
    for (int64_t g = first_groups_[thread]; g < first_groups_[thread + 1]; ++g)
      for (int64_t k = groups_[g].begin; k < groups_[g].end; ++k)
        for (int l = 0; l < lanes; ++l) visit(groups_[g], k, l);
  }

  // Brings a thread's particles to where `order_` wants them.
  void rearrange(int thread) {
    strays_[thread] = 0;
    each_place(thread, [&](const Group& group, int64_t k, int l) {
      const int64_t from = order_[k * lanes + l], m = from % lanes;
      const bool none = from < 0;
      const Block& old = old_blocks_[none ? 0 : from / lanes];
      Block& block = blocks_[k];
      names_[k][l] = none ? -1 : old_names_[from / lanes][m];
      block.mass[l] = none ? 0 : old.mass[m];
      block.volume[l] = none ? 0 : old.volume[m];
      for (int a = 0; a < d; ++a) {
        block.x[a][l] = none ? group.middle[a][l] * spacing_ : old.x[a][m];
        for (int b = 0; b < d; ++b) block.F[a][b][l] = none ? T(a == b) : old.F[a][b][m];
      }
    });
  }

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

  // The velocities of the rows that begin with a thread's first group; sums are cleared.
  void update_grid(int thread, T dt) {
    T* velocity = numbers(velocity_);
    for (int64_t row = first_rows_[thread]; row < first_rows_[thread + 1]; ++row) {
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
    for (int64_t g = first_groups_[thread]; g < first_groups_[thread + 1]; ++g) {
      const Group& group = groups_[g];
      Vector nodes[corners][d], sums[corners][columns] = {};
      if constexpr (takes) {
        read<true>(runs_[group.first_run], nodes);
        for (int r = group.first_run + 1; r < group.last_run; ++r) read<false>(runs_[r], nodes);
      }
      for (int64_t k = group.begin; k < group.end; ++k) {
        Block& block = blocks_[k];
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
        for (int r = group.first_run; r < group.last_run; ++r) add(thread, runs_[r], sums);
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
    each_place(thread, [&](const Group&, int64_t k, int l) {
      const int64_t p = names_[k][l];
      if (p < 0) return;
      for (int a = 0; a < d; ++a) {
        x[p * d + a] = blocks_[k].x[a][l];
        v[p * d + a] = motions_[k].v[a][l];
        for (int b = 0; b < d; ++b) F[(p * d + a) * d + b] = blocks_[k].F[a][b][l];
      }
    });
  }

  // The numbers of a grid; a vector before them and one after them are never nodes.
  static T* numbers(std::vector<Vector>& grid) { return reinterpret_cast<T*>(grid.data() + 1); }
  static const T* numbers(const std::vector<Vector>& grid) { return reinterpret_cast<const T*>(grid.data() + 1); }

  int64_t count_, shape_[d], length_;
  T spacing_, mu_, lambda_, gravity_[d];
  int threads_;
  std::vector<Block> blocks_, old_blocks_;
  std::vector<Motion> motions_;
  std::vector<Name> names_, old_names_;
  std::vector<Group> groups_;
  std::vector<Run> runs_;
  std::vector<int32_t> cells_, order_;  // of each place of a particle
  std::vector<int64_t> first_groups_, first_rows_;  // where each thread's groups, and its rows of nodes, begin
  std::vector<int64_t> strays_;
  std::vector<std::vector<Reach>> reach_;  // of each row, for each thread
  std::vector<std::vector<Vector>> sums_;
  std::vector<Vector> velocity_;
  int64_t rows_;
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
