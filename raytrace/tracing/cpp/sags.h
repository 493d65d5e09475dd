// The kinds of sag, S = c u/(1 + w) + Σ a_j b_j(u) with u = r²: raytrace/system/shapes.py. A new kind is one more `Kind`, in
// the order of the `code` of its row there, and a case of `add_terms`, `sum_terms` and `by_kind_of_terms`.
#pragma once
#include <type_traits>

#include "block.h"

namespace raytrace {

enum Kind { kPlane, kSphere, kConic, kEven, kOdd, kToroidal, kBiconic, kWithSagTerms };

constexpr bool has_terms(int kind) { return kind == kEven || kind == kOdd; }
constexpr bool is_freeform(int kind) { return kind == kToroidal || kind == kBiconic; }  // see freeform.h
constexpr bool has_sag_terms(int kind) { return kind == kWithSagTerms; }  // an even asphere and what sag_terms.h adds
constexpr bool is_searched(int kind) { return kind >= kEven; }

template <int number>
using Constant = std::integral_constant<int, number>;

// Adds Σ a_j u^(j+1) over every `stride`-th of the coefficients, and its derivatives by u.
template <bool second, int stride = 1, typename T>
inline void series(const T* a, int count, T u, T& S, T& dS, T& d2S) {
  T p = 0, dp = 0, d2p = 0;  // d2p carries p''/2
  for (int j = count - 1; j >= 0; j--) {
    if (second) d2p = d2p * u + dp;
    dp = dp * u + p;
    p = p * u + a[stride * j];
  }
  S = S + u * p, dS = dS + p + u * dp;
  if (second) d2S = d2S + 2 * dp + 2 * u * d2p;
}

// r and its slope by u: that of a cone at its tip is the mean of all directions.
template <typename T>
struct Radius {
  T r, dr;
  explicit Radius(T u) {
    bool apart = u > T(1e-24);
    T at = root(apart ? u : T(1));
    r = apart ? at : T(0), dr = apart ? T(0.5) / at : T(0);
  }
};

// Adds Σ a_j b_j(u) to a sag, and its derivatives.
template <int kind, bool second, typename T>
inline void add_terms(const T* a, int count, T u, T& S, T& dS, T& d2S) {
  if constexpr (kind == kOdd) {  // those of even j, and r q with q = a_1 + a_3 u + …
    const Radius<T> at(u);
    T q = a[0], dq = 0, d2q = 0;
    series<second, 2>(a + 1, count / 2, u, S, dS, d2S);
    series<second, 2>(a + 2, (count - 1) / 2, u, q, dq, d2q);
    S += at.r * q, dS += at.dr * q + at.r * dq;
    if (second) d2S += at.r * d2q + 2 * at.dr * (dq - at.dr * at.dr * q);
  } else {
    series<second>(a, count, u, S, dS, d2S);
  }
}

// What a_j of Σ a_j v u^j, v = u or r, gets from each ray, s b_j + S̄' b_j', summed; s and S̄' stand in notes.px and py.
template <int stride = 1, bool by_radius = false, bool along_y = false, typename T>
void sum_series(const Rays<T>& to, Notes<T>& notes, int n, int count, T* sums) {
#pragma omp simd
  for (int i = 0; i < n; i++) notes.pz[i] = 1;
  for (int j = 0; j < count; j++) {
    T sum = 0;
#pragma omp simd reduction(+ : sum)
    for (int i = 0; i < n; i++) {
      T u = along_y ? to.y[i] * to.y[i] : to.x[i] * to.x[i] + to.y[i] * to.y[i];
      if constexpr (by_radius) {
        const Radius<T> at(u);
        sum += notes.pz[i] * (notes.px[i] * at.r + T(2 * j + 1) * at.dr * notes.py[i]);
      } else {
        sum += notes.pz[i] * (notes.px[i] * u + T(j + 1) * notes.py[i]);
      }
      notes.pz[i] *= u;
    }
    sums[stride * j] += sum;
  }
}

// The same of all coefficients of a kind.
template <int kind, typename T>
void sum_terms(const Rays<T>& to, Notes<T>& notes, int n, int count, T* sums) {
  if constexpr (kind == kOdd) {
    sum_series<2, true>(to, notes, n, (count + 1) / 2, sums);
    sum_series<2>(to, notes, n, count / 2, sums + 1);
  } else {
    sum_series(to, notes, n, count, sums);
  }
}

// Calls work(kind, terms) for a surface with terms: loops are compiled for these kinds, and up to so many terms.
template <typename Work>
void by_kind_of_terms(const Layout& at, Work work) {
  if (at.kind == kOdd) work(Constant<kOdd>{}, Constant<8>{});
  else if (at.kind == kToroidal && at.terms == 1) work(Constant<kToroidal>{}, Constant<1>{});
  else if (at.kind == kToroidal) work(Constant<kToroidal>{}, Constant<8>{});
  else if (at.kind == kBiconic) work(Constant<kBiconic>{}, Constant<2>{});
  else if (at.kind == kWithSagTerms && at.terms == 0) work(Constant<kWithSagTerms>{}, Constant<0>{});
  else if (at.kind == kWithSagTerms) work(Constant<kWithSagTerms>{}, Constant<kTerms>{});
  else if (at.terms <= 4) work(Constant<kEven>{}, Constant<4>{});
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
  S = s.c * u / (T(1) + w), dS = T(0.5) * s.c * over_w, d2S = 0;
  add_terms<kind, second>(s.a, terms, u, S, dS, d2S);
  return inside;
}

// S and its slope where the kind is not known before; size: what the terms add up from.
struct Slope { double S, dS, size; bool inside; };

inline Slope slope_at(const Surface<double>& s, double u) {
  Slope found{};
  double sizes[kTerms], d = 0, d2 = 0;
  for (int j = 0; j < kTerms; j++) sizes[j] = std::fabs(s.a[j]);
  by_kind_of_terms(*s.at, [&](auto kind, auto) {
    if constexpr (has_terms(kind()) || has_sag_terms(kind())) {
      found.inside = sag<kind(), false>(s, s.at->terms, u, found.S, found.dS, d2);
      add_terms<kind(), false>(sizes, s.at->terms, u, found.size, d, d2);
    }
  });
  return found;
}

}  // namespace raytrace
