// Numbers with derivatives: a function written for them, as a sag, has its value, its slopes and its local Jacobian.
//
// A Jet has a first derivative by each variable in `first`, a bit each, and a second one by each pair of a row and a
// variable in `second`, at bit kVariables · row + variable. Rows are variables, too: those in `rows`. Other derivatives
// are 0 and take no time. A loop over rays is vectorised where a function of its own makes the jets of a ray, no struct
// of jets among them, and selects between numbers, not between jets.
#pragma once
#include <cstdint>
#include <limits>
#include <type_traits>

#include "block.h"

namespace raytrace {

using Mask = uint64_t;
constexpr int kVariables = 12, kRows = 3;

template <int number>
using Constant = std::integral_constant<int, number>;

constexpr bool has(Mask mask, int bit) { return mask >> bit & 1; }
constexpr int place_of_pair(int a, int b) { return a < b ? kVariables * a + b : kVariables * b + a; }

// The pairs of which a product of numbers with these first derivatives has a second one.
constexpr Mask pairs_of(Mask rows, Mask a, Mask b) {
  Mask pairs = 0;
  for (int r = 0; r < kRows; r++)
    for (int v = r; v < kVariables; v++)
      if (has(rows, r) && ((has(a, r) && has(b, v)) || (has(a, v) && has(b, r)))) pairs |= Mask(1) << place_of_pair(r, v);
  return pairs;
}

// Calls work(bit) for the bits of a mask.
template <Mask mask, typename Work>
[[gnu::always_inline]] inline void each(Work work) {
  if constexpr (mask != 0) {
    work(Constant<__builtin_ctzll(mask)>{});
    each<mask & (mask - 1)>(work);
  }
}

// 0, which the compiler leaves out.
struct Zero {};
inline Zero operator+(Zero, Zero) { return {}; }
inline Zero operator*(Zero, Zero) { return {}; }
template <typename T>
[[gnu::always_inline]] inline T operator+(const T& a, Zero) { return a; }
template <typename T>
[[gnu::always_inline]] inline T operator+(Zero, const T& a) { return a; }
template <typename T>
inline Zero operator*(const T&, Zero) { return {}; }
template <typename T>
inline Zero operator*(Zero, const T&) { return {}; }

template <typename T>
inline T as(T a) { return a; }
template <typename T>
inline T as(Zero) { return 0; }

template <typename T, Mask rows, Mask first = 0, Mask second = 0>
struct Jet {
  T v, d[kVariables], h[kVariables * kRows];
  bool inside = true;  // whether every root on the way was of a positive number

  template <int i>
  inline auto by() const {
    if constexpr (has(first, i)) return d[i];
    else return Zero{};
  }
  template <int i, int j>
  inline auto by() const {
    if constexpr (has(second, place_of_pair(i, j))) return h[place_of_pair(i, j)];
    else return Zero{};
  }
};

template <Mask rows, typename T>
inline Jet<T, rows> constant(T value) {
  Jet<T, rows> to;
  to.v = value;
  return to;
}

// A variable, or a number that changes by `slope` with it.
template <Mask rows, int i, typename T>
inline Jet<T, rows, Mask(1) << i> variable(T value, T slope = 1) {
  Jet<T, rows, Mask(1) << i> to;
  to.v = value, to.d[i] = slope;
  return to;
}

// Sets the derivatives of a jet, each by its place, and the pair of a second one.
template <typename T, Mask rows, Mask first, Mask second, typename First, typename Second>
[[gnu::always_inline]] inline void derive(Jet<T, rows, first, second>& to, First by, Second by_pair) {
  each<first>([&](auto i) { to.d[i()] = by(i); });
  each<second>([&](auto at) { to.h[at()] = by_pair(Constant<at() / kVariables>{}, Constant<at() % kVariables>{}); });
}

#define BY(jet, ...) jet.template by<__VA_ARGS__>()
#define ONE_JET template <typename T, Mask rows, Mask a1, Mask a2> [[gnu::always_inline]] inline
#define TWO_JETS template <typename T, Mask rows, Mask a1, Mask a2, Mask b1, Mask b2> [[gnu::always_inline]] inline
#define JET_A const Jet<T, rows, a1, a2>& a
#define JET_B const Jet<T, rows, b1, b2>& b

// f(a), by f and its two derivatives.
ONE_JET auto composed(JET_A, T f, T f1, T f2) {
  Jet<T, rows, a1, a2 | pairs_of(rows, a1, a1)> to;
  to.v = f, to.inside = a.inside;
  derive(to, [&](auto i) { return f1 * BY(a, i()); },
         [&](auto r, auto i) { return f1 * BY(a, r(), i()) + f2 * BY(a, r()) * BY(a, i()); });
  return to;
}

TWO_JETS auto operator*(JET_A, JET_B) {
  Jet<T, rows, a1 | b1, a2 | b2 | pairs_of(rows, a1, b1)> to;
  to.v = a.v * b.v, to.inside = a.inside & b.inside;
  derive(to, [&](auto i) { return BY(a, i()) * b.v + a.v * BY(b, i()); },
         [&](auto r, auto i) {
           return (BY(a, r(), i()) * b.v + a.v * BY(b, r(), i())) + (BY(a, r()) * BY(b, i()) + BY(a, i()) * BY(b, r()));
         });
  return to;
}
TWO_JETS auto operator+(JET_A, JET_B) {
  Jet<T, rows, a1 | b1, a2 | b2> to;
  to.v = a.v + b.v, to.inside = a.inside & b.inside;
  derive(to, [&](auto i) { return BY(a, i()) + BY(b, i()); },
         [&](auto r, auto i) { return BY(a, r(), i()) + BY(b, r(), i()); });
  return to;
}
ONE_JET auto operator-(JET_A) {
  Jet<T, rows, a1, a2> to;
  to.v = -a.v, to.inside = a.inside;
  derive(to, [&](auto i) { return -a.d[i()]; }, [&](auto r, auto i) { return -BY(a, r(), i()); });
  return to;
}
TWO_JETS auto operator-(JET_A, JET_B) { return a + -b; }
ONE_JET auto operator*(std::common_type_t<T> f, JET_A) { return constant<rows>(f) * a; }
ONE_JET auto operator+(std::common_type_t<T> f, JET_A) { return constant<rows>(f) + a; }
ONE_JET auto operator-(std::common_type_t<T> f, JET_A) { return f + -a; }

ONE_JET auto magnitude(JET_A) { return (a.v < 0 ? -1.0 : 1.0) * a; }
ONE_JET auto square(JET_A) { return composed(a, a.v * a.v, T(2) * a.v, T(2)); }
template <typename T>
inline T inverse(T a) { return T(1) / a; }
ONE_JET auto inverse(JET_A) {
  const T over = T(1) / a.v, squared = over * over;
  return composed(a, over, -squared, T(2) * squared * over);
}
TWO_JETS auto operator/(JET_A, JET_B) { return a * inverse(b); }

// √a where a > 0 and, if given, `also`; elsewhere 0+ without slope.
ONE_JET auto root(JET_A, bool also = true) {
  const bool inside = (a.v > 0) & also;
  const T w = root(inside ? a.v : std::numeric_limits<T>::min()), half = inside ? T(0.5) / w : T(0);
  auto to = composed(a, w, half, T(-2) * half * half * half);
  to.inside = a.inside & inside;
  return to;
}
// 1/(1 + √a), which has one division less.
ONE_JET auto share(JET_A) {
  const bool inside = a.v > 0;
  const T w = root(inside ? a.v : std::numeric_limits<T>::min()), both = T(1) / (w * (T(1) + w));
  const T f = w * both, over_w = inside ? (T(1) + w) * both : T(0), f1 = T(-0.5) * f * f * over_w;
  auto to = composed(a, f, f1, -f1 * over_w * (f + T(0.5) * over_w));
  to.inside = a.inside & inside;
  return to;
}
ONE_JET auto sine(JET_A) {
  const T s = std::sin(a.v);
  return composed(a, s, std::cos(a.v), -s);
}
ONE_JET auto cosine(JET_A) {
  const T c = std::cos(a.v);
  return composed(a, c, -std::sin(a.v), -c);
}

}  // namespace raytrace
