// The kinds of sag: raytrace/system/shapes.py. A kind is a struct of `Sags`, whose sag is written once, on jets: trace,
// adjoint and tangents take its value, its slopes and its local Jacobian. Its row there has its place in `Kind`.
//
//     sag(n, x, y)   by the numbers n: n.c() curvature, n.k() conic constant, n.a<j>() coefficients
//     sag(n, u)      of a conic with terms in u = r²
//     n.terms<j>(v) = a_j v + a_(j+1) v² + …,   n.odd_terms<j>(u) = a_j r + a_(j+1) r² + …
#pragma once
#include <tuple>
#include <utility>

#include "jet.h"

namespace raytrace {

constexpr int kHeads = 4;
enum Variable { kX, kY, kZ, kC, kK, kA, kHeight = kA + kHeads, kSlope };  // kA + j: a<j>; the last two: of the terms
constexpr Mask kAllRows = 7, kNoRows = 0;

// What the numbers are: constants, the variables of a Jacobian, or all of them functions of one variable, kC.
enum How { kStill, kVaried, kMoved };

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

// Σ a_j u^j or Σ a_j r^j, j = 1, 2, …, and its derivatives by u.
template <typename T>
struct Terms { T S, dS, d2S; };

template <bool odd, bool second, typename T>
inline Terms<T> terms_of(const T* a, int count, T u) {
  Terms<T> to{};
  if constexpr (odd) {  // terms of even j, and r q with q = a_1 + a_3 u + …
    const Radius<T> at(u);
    T q = a[0], dq = 0, d2q = 0;
    series<second, 2>(a + 1, count / 2, u, to.S, to.dS, to.d2S);
    series<second, 2>(a + 2, (count - 1) / 2, u, q, dq, d2q);
    to.S += at.r * q, to.dS += at.dr * q + at.r * dq;
    if (second) to.d2S += at.r * d2q + 2 * at.dr * (dq - at.dr * at.dr * q);
  } else {
    series<second>(a, count, u, to.S, to.dS, to.d2S);
  }
  return to;
}

// The numbers of a surface with up to `count` coefficients as jets.
template <typename T, Mask rows, How how, int count>
struct Numbers {
  const Surface<T>& s;
  const Change<T>* change;  // of kMoved

  template <int i, typename Pick>
  [[gnu::always_inline]] auto number(Pick pick) const {
    if constexpr (how == kStill) return constant<rows>(pick(s));
    else if constexpr (how == kVaried) return variable<rows, i>(pick(s));
    else return variable<rows, kC>(pick(s), pick(*change));
  }
  auto c() const { return number<kC>([](const auto& of) { return of.c; }); }
  auto k() const { return number<kK>([](const auto& of) { return of.k; }); }
  template <int j>
  auto a() const { return number<kA + j>([](const auto& of) { return of.a[j]; }); }

  // Coefficients change the sum by a height and a slope along v.
  template <int first, bool odd = false, Mask a1, Mask a2>
  [[gnu::always_inline]] auto terms(const Jet<T, rows, a1, a2>& v) const {
    if constexpr (first >= count) {
      return Zero{};
    } else {
      const auto of = terms_of<odd, rows != 0>(s.a + first, count - first, v.v);
      const auto sum = composed(v, of.S, of.dS, of.d2S);
      if constexpr (how == kStill) return sum;
      else if constexpr (how == kVaried) return sum + change_along<kHeight, kSlope>(v, T(1), T(1));
      else {
        const auto more = terms_of<odd, false>(change->a + first, count - first, v.v);
        return sum + change_along<kC, kC>(v, more.S, more.dS);
      }
    }
  }
  template <int first, Mask a1, Mask a2>
  auto odd_terms(const Jet<T, rows, a1, a2>& v) const { return terms<first, true>(v); }

 private:
  template <int height, int slope, Mask a1, Mask a2>
  [[gnu::always_inline]] static auto change_along(const Jet<T, rows, a1, a2>& v, T by_height, T by_slope) {
    Jet<T, rows, Mask(1) << height, pairs_of(rows, a1, Mask(1) << slope)> to;
    to.v = 0;
    derive(to, [=](auto) { return by_height; }, [&](auto r, auto) { return by_slope * BY(v, r()); });
    return to;
  }
};

// c u/(1 + w), w = √(1 - (1+k) c² u).
template <typename C, typename K, typename U>
[[gnu::always_inline]] inline auto conic(const C& c, const K& k, const U& u) {
  return c * u * share(1 - (1 + k) * c * c * u);
}
// With its slope c/2w by hand: Newton's method without it takes 24 % more of a trace through aspheres, 18 % with adjoint.
template <typename T, Mask first>
[[gnu::always_inline]] inline auto conic(const Jet<T, kNoRows>& c, const Jet<T, kNoRows>& k,
                                         const Jet<T, kNoRows, first>& u) {
  const T radicand = T(1) - (T(1) + k.v) * c.v * c.v * u.v;
  const T w = root(radicand > 0 ? radicand : std::numeric_limits<T>::min());
  auto to = composed(u, c.v * u.v / (T(1) + w), T(0.5) * c.v / w, T(0));
  to.inside = radicand > 0;
  return to;
}

// is_round: a conic with terms in r, odd: of all powers; heads: coefficients that are no terms, at most kHeads; along_y:
// the terms are in y². Loops are compiled for so many coefficients as `Sizes` has.
struct Sag {
  static constexpr int heads = 0;
  static constexpr bool is_round = false, odd = false, along_y = false;
};

struct Even : Sag {
  static constexpr bool is_round = true;
  using Sizes = std::integer_sequence<int, 4, 8, kTerms>;
  template <typename N, typename U>
  [[gnu::always_inline]] static auto sag(const N& n, const U& u) {
    return conic(n.c(), n.k(), u) + n.template terms<0>(u);
  }
};

// An even asphere and what sag_terms.h adds.
struct EvenWithSagTerms : Even {
  using Sizes = std::integer_sequence<int, 0, kTerms>;
};

struct Odd : Sag {
  static constexpr bool is_round = true, odd = true;
  using Sizes = std::integer_sequence<int, 8>;
  template <typename N, typename U>
  [[gnu::always_inline]] static auto sag(const N& n, const U& u) {
    return conic(n.c(), n.k(), u) + n.template odd_terms<0>(u);
  }
};

// z = g + c_x x²/(q + w), w = √(q² - c_x² x²), q = 1 - c_x g, g = g(y), as far as the circle about the axis gets to x.
struct Toroidal : Sag {
  static constexpr int heads = 1;
  static constexpr bool along_y = true;
  using Sizes = std::integer_sequence<int, 1, 8>;
  template <typename N, typename X, typename Y>
  [[gnu::always_inline]] static auto sag(const N& n, const X& x, const Y& y) {
    const auto c_x = n.template a<0>();
    const auto u = square(y);
    const auto g = conic(n.c(), n.k(), u) + n.template terms<1>(u);
    const auto p = c_x * x;
    const auto q = 1 - c_x * g;
    return g + x * p / (q + root((q - p) * (q + p), q.v > 0));
  }
};

// z (1 + w) = c_x x² + c y², w² = 1 - (1+k_x) c_x² x² - (1+k) c² y².
struct Biconic : Sag {
  static constexpr int heads = 2;
  using Sizes = std::integer_sequence<int, 2>;
  template <typename N, typename X, typename Y>
  [[gnu::always_inline]] static auto sag(const N& n, const X& x, const Y& y) {
    const auto p = n.template a<0>() * x;
    const auto q = n.c() * y;
    return (x * p + y * q) * share(1 - (1 + n.template a<1>()) * square(p) - (1 + n.k()) * square(q));
  }
};

using Sags = std::tuple<EvenWithSagTerms, Even, Odd, Toroidal, Biconic>;
enum Kind { kPlane, kSphere, kConic, kWithSagTerms, kEven, kOdd, kToroidal, kBiconic };  // and those that follow in Sags
constexpr int kKinds = kWithSagTerms + std::tuple_size_v<Sags>;

constexpr bool is_searched(int kind) { return kind >= kWithSagTerms; }
constexpr bool is_unit(int kind) { return kind == kPlane || kind == kSphere; }  // F has slopes of length 1
constexpr bool has_sag_terms(int kind) { return kind == kWithSagTerms; }
template <int kind>
using SagOf = std::tuple_element_t<kind - kWithSagTerms, Sags>;

template <int kind>
constexpr bool is_round() {
  if constexpr (is_searched(kind)) return SagOf<kind>::is_round;
  else return true;
}

template <int kind = kWithSagTerms>
constexpr bool has_axis(int at) {  // the same of a searched kind
  if constexpr (kind < kKinds) return at == kind ? is_round<kind>() : has_axis<kind + 1>(at);
  else return false;
}

// Calls work(kind, size) for a searched surface: with its kind, and the size of the loops compiled for it.
template <int kind, typename Work, int... sizes>
inline void by_size(const Layout& at, Work& work, std::integer_sequence<int, sizes...>) {
  bool done = false;
  ((done || at.terms > sizes ? void() : (done = true, work(Constant<kind>{}, Constant<sizes>{}))), ...);
}
template <int kind = kWithSagTerms, typename Work>
void by_kind_of_terms(const Layout& at, Work work) {
  if (at.kind == kind) by_size<kind>(at, work, typename SagOf<kind>::Sizes{});
  else if constexpr (kind + 1 < kKinds) by_kind_of_terms<kind + 1>(at, work);
}

// A round sag S(u) as one of x and y; over: 1/span, of derivatives by u/span.
template <Mask rows, typename T, Mask along, Mask a1, Mask a2>
[[gnu::always_inline]] inline auto round_about(const Jet<T, along, a1, a2>& S, T x, T y, T over) {
  constexpr Mask numbers = a1 & ~Mask(1), crossed = a2 & ~Mask(1);  // pairs of u and a number are at the number's bit
  constexpr Mask second = rows == 0 ? 0 : pairs_of(rows, 3, 3) | crossed | crossed << kVariables;
  Jet<T, rows, 3 | numbers, second> to;
  to.v = S.v, to.inside = S.inside;
  const T rise = T(2) * S.d[0] * over, bend = T(4) * as<T>(BY(S, kX, kX)), across = over * x, up = over * y;
  to.d[kX] = rise * x, to.d[kY] = rise * y;
  each<numbers>([&](auto i) { to.d[i()] = S.d[i()]; });
  if constexpr (rows != 0) {
    to.h[place_of_pair(kX, kX)] = rise + bend * across * across, to.h[place_of_pair(kY, kY)] = rise + bend * up * up;
    to.h[place_of_pair(kX, kY)] = bend * across * up;
    each<crossed>([&](auto i) {
      to.h[i()] = T(2) * S.h[i()] * across, to.h[i() + kVariables] = T(2) * S.h[i()] * up;
    });
  }
  return to;
}

// The sag of a kind at a point, by x, y and the numbers.
template <int kind, int size, How how, Mask rows, typename T>
[[gnu::always_inline]] inline auto sag_at(const Surface<T>& s, T x, T y, const Change<T>* change = nullptr) {
  if constexpr (is_round<kind>()) {
    const Numbers<T, rows & 1, how, size> numbers{s, change};
    const auto u = rows == kNoRows ? variable<rows & 1, kX>(x * x + y * y)
                                   : variable<rows & 1, kX>(x * x + y * y, s.span);
    return round_about<rows>(SagOf<kind>::sag(numbers, u), x, y, rows == kNoRows ? T(1) : s.over_span);
  } else {
    const Numbers<T, rows, how, size> numbers{s, change};
    return SagOf<kind>::sag(numbers, variable<rows, kX>(x), variable<rows, kY>(y));
  }
}

// Σ |a_j| b_j: what the terms add up from.
template <int kind>
double size_of_terms(const Surface<double>& s, double x, double y) {
  using Kind = SagOf<kind>;
  double sizes[kTerms];
  for (int j = 0; j < kTerms; j++) sizes[j] = std::fabs(s.a[j]);
  if (s.at->terms <= Kind::heads) return 0;
  const double v = Kind::along_y ? y * y : x * x + y * y;
  return terms_of<Kind::odd, false>(sizes + Kind::heads, s.at->terms - Kind::heads, v).S;
}

// The quadric that osculates at the vertex; of a sag that is not round, as round as the section that counts more at a ray.
template <typename T, bool round>
struct Osculating {
  T c_x, c_y, c_z;

  // Whether a ray meets it, by its foot; t: the path from there.
  bool meets(T x, T y, T z, T L, T M, T N, T& t) const {
    T along = round ? c_z : magnitude(c_x * x * x) > magnitude(c_y * y * y) ? c_x : c_y;
    T A = c_x * L * L + c_y * M * M + along * N * N, G = N - (c_x * x * L + c_y * y * M + along * z * N);
    T F = c_x * x * x + c_y * y * y + along * z * z - T(2) * z, discriminant = G * G - A * F;
    bool usable = (discriminant > 0) & (G * N > 0);
    t = F / (usable ? G + signed_as(root(usable ? discriminant : T(1)), N) : T(1));
    return usable;
  }
};

template <int kind, int count, typename T>
Osculating<T, is_round<kind>()> osculating(const Surface<T>& s) {
  if constexpr (is_round<kind>()) return {s.c, s.c, (T(1) + s.k) * s.c};
  const auto S = sag_at<kind, count, kStill, kAllRows>(s, T(0), T(0));
  return {as<T>(BY(S, kX, kX)), as<T>(BY(S, kY, kY)), 0};
}

// What a_j of Σ a_j v u^j, v = u or r, gets from each ray, s b_j + S̄' b_j', summed; s and S̄' stand in notes.px and py.
template <int stride = 1, bool by_radius = false, bool along_y = false, typename T, typename S>
void sum_series(const Rays<T>& to, Notes<T>& notes, int n, int count, S* sums) {
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

// The same of all terms of a kind.
template <int kind, typename T>
void sum_terms(const Rays<T>& to, Notes<T>& notes, int n, int count, T* sums) {
  using Kind = SagOf<kind>;
  if constexpr (Kind::odd) {
    sum_series<2, true>(to, notes, n, (count + 1) / 2, sums);
    sum_series<2>(to, notes, n, count / 2, sums + 1);
  } else {
    sum_series<1, false, Kind::along_y>(to, notes, n, count - Kind::heads, sums + Kind::heads);
  }
}

}  // namespace raytrace
