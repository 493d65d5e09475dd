// The kinds of sag, S = c u/(1 + w) + Σ a_j v^j with u = r²: raytrace/system/shapes.py. A new kind is one more `Kind`, in
// the order of the `code` of its row there, its v as a case of `argument`, and a line of `by_kind_of_terms`.
#pragma once
#include <type_traits>

#include "block.h"

namespace raytrace {

enum Kind { kPlane, kSphere, kConic, kEven };

constexpr bool has_terms(int kind) { return kind >= kEven; }

template <int number>
using Constant = std::integral_constant<int, number>;

// v(u) with its derivatives.
template <typename T>
struct Argument { T v, dv, d2v; };

template <int kind, typename T>
inline Argument<T> argument(T u) {
  return {u, T(1), T(0)};
}

// Calls work(kind, terms) for a surface with terms: loops are compiled for these kinds, and up to so many terms.
template <typename Work>
void by_kind_of_terms(const Layout& at, Work work) {
  if (at.terms <= 4) work(Constant<kEven>{}, Constant<4>{});
  else if (at.terms <= 8) work(Constant<kEven>{}, Constant<8>{});
  else work(Constant<kEven>{}, Constant<kTerms>{});
}

// S(u), its slope and, if asked for, what the terms add to its second derivative at u = r² (the conic's holds c³,
// which may leave the range of numbers: see the adjoint); returns whether the radicand of the conic is above 0.
template <int kind, bool second, typename T>
inline bool sag(const Surface<T>& s, int terms, T u, T& S, T& dS, T& d2S) {
  T shape = T(1) + s.k, radicand = T(1) - shape * s.c * s.c * u;
  bool inside = radicand > 0;
  T w = root(inside ? radicand : std::numeric_limits<T>::min()), over_w = T(1) / w;
  const Argument<T> at = argument<kind>(u);
  const T v = at.v;
  T p = 0, dp = 0, d2p = 0;
  for (int j = terms - 1; j >= 0; j--) {
    if (second) d2p = d2p * v + dp;
    dp = dp * v + p;
    p = p * v + s.a[j];
  }
  // Σ a_j v^(j+1) = v p, so its derivatives by v are p + v p' and 2 p' + v p''; d2p carries p''/2.
  S = s.c * u / (T(1) + w) + v * p;
  if constexpr (kind == kEven) {
    dS = T(0.5) * s.c * over_w + p + v * dp;
    if (second) d2S = 2 * dp + 2 * v * d2p;
  } else {
    dS = T(0.5) * s.c * over_w + (p + v * dp) * at.dv;
    if (second) d2S = (2 * dp + 2 * v * d2p) * at.dv * at.dv + (p + v * dp) * at.d2v;
  }
  return inside;
}

// S and its slope where the kind is not known before; `size`: c u/(1 + w) apart, what the terms add up from.
struct Slope { double S, dS, size; bool inside; };

inline Slope slope_at(const Surface<double>& s, double u) {
  Slope found{};
  by_kind_of_terms(*s.at, [&](auto kind, auto) {
    double d2S, v = argument<kind()>(u).v;
    found.inside = sag<kind(), false>(s, s.at->terms, u, found.S, found.dS, d2S);
    for (int j = s.at->terms - 1; j >= 0; j--) found.size = found.size * v + std::fabs(s.a[j]);
    found.size *= v;
  });
  return found;
}

}  // namespace raytrace
