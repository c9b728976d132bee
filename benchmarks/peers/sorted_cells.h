// Particles sorted by cell, for vectors whose lanes are cells: those of the particles with the same first node.
//
// A group has as many cells as a vector has lanes, mostly neighbours along the last axis; a block of a group has one
// particle of each. A cell with many particles has several lanes. Threads have groups of their own.

#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <type_traits>
#include <vector>

template <class T>
struct Lanes {
  typedef std::conditional_t<sizeof(T) == 4, int32_t, int64_t> Whole;
  typedef T Vector __attribute__((vector_size(64)));
  typedef Whole Mask __attribute__((vector_size(64)));
};

template <class T, int d>
struct Cells {
  static constexpr int lanes = 64 / sizeof(T);
  using Vector = typename Lanes<T>::Vector;
  using Mask = typename Lanes<T>::Mask;

  // One particle of each cell of a group; where a cell has no more of them, one without mass and volume.
  struct Block {
    Vector x[d], F[d][d], mass, volume;
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

  std::vector<Block> blocks;
  std::vector<std::array<int32_t, lanes>> names;  // of each block's particles, -1 of none
  std::vector<Group> groups;
  std::vector<Run> runs;
  std::vector<int64_t> first_groups;  // where each thread's begin, and after the last one's

  // Particles where they are, undeformed.
  Cells(int64_t count, const int64_t* shape, T spacing, const double* x, double mass, double volume, int threads)
      : blocks((count + lanes - 1) / lanes), names(blocks.size()), first_groups(threads + 1), count_(count), rows_(1),
        spacing_(spacing), threads_(threads), cells_(blocks.size() * lanes) {
    std::copy(shape, shape + d, shape_);
    for (int a = 0; a < d - 1; ++a) rows_ *= shape[a];
    for (int64_t p = 0; p < static_cast<int64_t>(blocks.size()) * lanes; ++p) {
      Block& block = blocks[p / lanes];
      const int64_t l = p % lanes, q = std::min(p, count - 1);
      names[p / lanes][l] = p < count ? p : -1;
      block.mass[l] = mass, block.volume[l] = volume;
      for (int a = 0; a < d; ++a) {
        block.x[a][l] = x[q * d + a];
        for (int b = 0; b < d; ++b) block.F[a][b][l] = a == b;
      }
    }
    for (int thread = 0; thread < threads; ++thread) find_cells(thread);
    sort();
    for (int thread = 0; thread < threads; ++thread) rearrange(thread);
  }

  // The cell of each particle of a thread's, -1 of none.
  void find_cells(int thread) {
    const int64_t number = blocks.size();
    for (int64_t k = number * thread / threads_; k < number * (thread + 1) / threads_; ++k)
      for (int l = 0; l < lanes; ++l) {
        int64_t cell = 0;
        for (int a = 0; a < d; ++a)
          cell = cell * shape_[a] + static_cast<int32_t>(blocks[k].x[a][l] * (1 / spacing_) - T(0.5));
        cells_[k * lanes + l] = names[k][l] < 0 ? -1 : cell;
      }
  }

  // Groups of cells, with the present place of each particle in `order_`, -1 for none.
  void sort() {
    blocks.swap(old_blocks_);
    names.swap(old_names_);
    const int64_t nodes = rows_ * shape_[d - 1];
    std::vector<int32_t> begins(nodes + 2), listed(count_);
    for (auto cell : cells_)
      if (cell >= 0) ++begins[cell + 2];
    for (int64_t cell = 0; cell < nodes; ++cell) begins[cell + 2] += begins[cell + 1];
    for (size_t p = 0; p < cells_.size(); ++p)
      if (cells_[p] >= 0) listed[begins[cells_[p] + 1]++] = p;

    const int64_t depth = lane_depth(begins);
    groups.clear(), runs.clear(), order_.clear();
    int lane = lanes;
    auto add_lane = [&](int64_t row, int64_t node, int64_t begin, int64_t end) {
      if (lane == lanes) {
        const int64_t block = order_.size() / lanes;
        groups.push_back(Group{block, block, static_cast<int>(runs.size()), 0, {}});
        lane = 0;
      }
      if (lane == 0 || runs.back().row != row || runs.back().node + lane != node)
        runs.push_back(Run{row, node - lane, lane, lane, Mask{}});
      runs.back().mask[lane] = -1;
      runs.back().end = lane + 1;
      Group& group = groups.back();
      group.last_run = runs.size();
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
    names.resize(order_.size() / lanes), blocks.resize(names.size()), cells_.resize(order_.size());
    const int64_t places = order_.size(), last = groups.size();
    for (int64_t thread = 1, group = 0; thread < threads_; ++thread) {  // about as many blocks each
      while (group < last && groups[group].begin * lanes * threads_ < places * thread) ++group;
      first_groups[thread] = group;
    }
    first_groups[threads_] = last;
  }

  // Calls `visit` with the group, the block and the lane of each of a thread's places.
  template <class Visit>
  void each_place(int thread, Visit visit) const {
    for (int64_t g = first_groups[thread]; g < first_groups[thread + 1]; ++g)
      for (int64_t k = groups[g].begin; k < groups[g].end; ++k)
        for (int l = 0; l < lanes; ++l) visit(groups[g], k, l);
  }

  // Brings a thread's particles to where `order_` wants them.
  void rearrange(int thread) {
    each_place(thread, [&](const Group& group, int64_t k, int l) {
      const int64_t from = order_[k * lanes + l], m = from % lanes;
      const bool none = from < 0;
      const Block& old = old_blocks_[none ? 0 : from / lanes];
      Block& block = blocks[k];
      names[k][l] = none ? -1 : old_names_[from / lanes][m];
      block.mass[l] = none ? 0 : old.mass[m];
      block.volume[l] = none ? 0 : old.volume[m];
      for (int a = 0; a < d; ++a) {
        block.x[a][l] = none ? group.middle[a][l] * spacing_ : old.x[a][m];
        for (int b = 0; b < d; ++b) block.F[a][b][l] = none ? T(a == b) : old.F[a][b][m];
      }
    });
  }

 private:
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

  int64_t count_, shape_[d], rows_;
  T spacing_;
  int threads_;
  std::vector<int32_t> cells_, order_;  // of each place of a particle
  std::vector<Block> old_blocks_;
  std::vector<std::array<int32_t, lanes>> old_names_;
};
