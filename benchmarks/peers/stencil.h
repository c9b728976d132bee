// The quadratic kernel along each axis, and sums over the 3^d nodes of a stencil, axis by axis.

#pragma once

#include <array>

#define INLINE [[gnu::always_inline]] inline

constexpr int power_of_three(int n) { return n == 0 ? 1 : 3 * power_of_three(n - 1); }

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
