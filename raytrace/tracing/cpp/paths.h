// Paths p(x, y) that a phase adds, with their derivatives, over a block or at one point: raytrace/system/phases.py.
//
//     polynomial  c + Σ c_k x^i y^j in the order x, y, x², xy, y², x³, …    radial  Σ a_j u^j, u = r², j = 1, 2, …
//     hologram    s Σ (|P - Q| - |Q|) over two points Q = (a, b, c); the numbers are theirs, and s
//
// A new form is one more `Form`, in the order of FORMS in structure.py, and a case of `path_at`, `path_change` and `sum_path`.
#pragma once
#include "sags.h"

namespace raytrace {

enum Form { kNoPhase, kPolynomial, kRadial, kSlopes, kHologram, kFacets };

// Least degree n whose n(n + 3)/2 terms are `count` or more.
inline int degree(int count) {
  int n = 0;
  while (n * (n + 3) / 2 < count) n++;
  return n;
}

// Place of x^i y^j among the terms.
inline int place_of(int i, int j) { return (i + j - 1) * (i + j + 2) / 2 + j; }

template <typename T, int size>
void clear(Added<T, size>& to, int n) {
  for (T* part : {to.p, to.x, to.y, to.xx, to.xy, to.yy}) std::memset(part, 0, n * sizeof(T));
}

// A polynomial in x of the terms x^k y^j, from k on down, by Horner's rule, with its derivatives; the terms from 1 on.
template <bool second, int k, int j, typename T>
[[gnu::always_inline]] inline void along_x(const T* c, T x, T& q, T& dq, T& d2q) {
  if (second) d2q = d2q * x + dq;  // half of the second derivative
  dq = dq * x + q;
  q = q * x + c[place_of(k, j) + 1];
  if constexpr (k > 0) along_x<second, k - 1, j>(c, x, q, dq, d2q);
}

// Horner's rule in y over those of a degree, from j on down, at one point.
template <bool second, int top, int j, typename T>
[[gnu::always_inline]] inline void along_y(const T* c, T x, T y, T& p, T& px, T& py, T& pxx, T& pxy, T& pyy) {
  T q = 0, dq = 0, d2q = 0;
  along_x<second, top - j, j>(c, x, q, dq, d2q);
  if (second) pyy = pyy * y + T(2) * py, pxy = pxy * y + px, pxx = pxx * y + T(2) * d2q;
  py = py * y + p, px = px * y + dq, p = p * y + q;
  if constexpr (j > 0) along_y<second, top, j - 1>(c, x, y, p, px, py, pxx, pxy, pyy);
}

constexpr int kLow = 4;  // degree up to which a polynomial stays in registers

// Horner's rule in y over polynomials in x, each with its first derivative, and with the second if asked for.
template <bool second, typename C, typename T, int size>
void polynomial(const C* c, int count, const T* x, const T* y, int n, Added<T, size>& to) {
  const int top = degree(count);
  if (top > 1 && top <= kLow) {
    T terms[(kLow + 1) * (kLow + 2) / 2] = {};
    for (int k = 0; k < count; k++) terms[k + 1] = T(c[k]);
#pragma omp simd
    for (int i = 0; i < n; i++) {
      T p = 0, px = 0, py = 0, pxx = 0, pxy = 0, pyy = 0;
      along_y<second, kLow, kLow>(terms, x[i], y[i], p, px, py, pxx, pxy, pyy);
      to.p[i] = p, to.x[i] = px, to.y[i] = py;
      if (second) to.xx[i] = pxx, to.xy[i] = pxy, to.yy[i] = pyy;
    }
    return;
  }
  clear(to, n);
  if (count <= 2) {
    const T a = count > 0 ? T(c[0]) : T(0), b = count > 1 ? T(c[1]) : T(0);
#pragma omp simd
    for (int i = 0; i < n; i++) to.p[i] = a * x[i] + b * y[i], to.x[i] = a, to.y[i] = b;
    return;
  }
  for (int j = top; j >= 0; j--) {
    for (T* part : {to.q, to.dq, to.d2q}) std::memset(part, 0, n * sizeof(T));
    for (int k = top - j; k >= 0; k--) {
      const int place = place_of(k, j);
      const T a = place >= 0 && place < count ? T(c[place]) : T(0);
#pragma omp simd
      for (int i = 0; i < n; i++) {
        if (second) to.d2q[i] = to.d2q[i] * x[i] + to.dq[i];  // half of the second derivative
        to.dq[i] = to.dq[i] * x[i] + to.q[i];
        to.q[i] = to.q[i] * x[i] + a;
      }
    }
#pragma omp simd
    for (int i = 0; i < n; i++) {
      if (second) {
        to.yy[i] = to.yy[i] * y[i] + T(2) * to.y[i];
        to.xy[i] = to.xy[i] * y[i] + to.x[i];
        to.xx[i] = to.xx[i] * y[i] + T(2) * to.d2q[i];
      }
      to.y[i] = to.y[i] * y[i] + to.p[i];
      to.x[i] = to.x[i] * y[i] + to.dq[i];
      to.p[i] = to.p[i] * y[i] + to.q[i];
    }
  }
}

// The same behind its constant.
template <bool second, typename C, typename T, int size>
void with_constant(const C* c, int count, const T* x, const T* y, int n, Added<T, size>& to) {
  polynomial<second>(c + 1, count - 1, x, y, n, to);
  const T constant = T(c[0]);
#pragma omp simd
  for (int i = 0; i < n; i++) to.p[i] += constant;
}

// p = u q(u).
template <bool second, typename C, typename T, int size>
void radial(const C* a, int count, const T* x, const T* y, int n, Added<T, size>& to) {
  for (T* part : {to.q, to.dq, to.d2q}) std::memset(part, 0, n * sizeof(T));
  for (int j = count - 1; j >= 0; j--) {
    const T c = T(a[j]);
#pragma omp simd
    for (int i = 0; i < n; i++) {
      const T u = x[i] * x[i] + y[i] * y[i];
      if (second) to.d2q[i] = to.d2q[i] * u + to.dq[i];
      to.dq[i] = to.dq[i] * u + to.q[i];
      to.q[i] = to.q[i] * u + c;
    }
  }
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const T u = x[i] * x[i] + y[i] * y[i], slope = to.q[i] + u * to.dq[i];
    to.p[i] = u * to.q[i], to.x[i] = T(2) * slope * x[i], to.y[i] = T(2) * slope * y[i];
    if (second) {
      const T bend = T(8) * (to.dq[i] + u * to.d2q[i]);
      to.xx[i] = T(2) * slope + bend * x[i] * x[i], to.yy[i] = T(2) * slope + bend * y[i] * y[i];
      to.xy[i] = bend * x[i] * y[i];
    }
  }
}

// Numbers of a path as jets; those that vary are variables behind x and y.
template <typename T, Mask rows, How how, typename C>
struct Entries {
  const C *numbers, *change;
  template <int j>
  [[gnu::always_inline]] auto at() const {
    if constexpr (how == kStill) return constant<rows>(T(numbers[j]));
    else if constexpr (how == kVaried) return variable<rows, 2 + j>(T(numbers[j]));
    else return variable<rows, 2>(T(numbers[j]), T(change[j]));
  }
};

// How much longer the way from point Q of a hologram to (x, y) is than to the vertex, |P - Q| - |Q|.
template <int first, typename N, typename X, typename Y>
[[gnu::always_inline]] inline auto from_point(const N& n, const X& x, const Y& y) {
  const auto a = n.template at<first>();
  const auto b = n.template at<first + 1>();
  const auto squared = square(n.template at<first + 2>());
  const auto far = root(square(a) + square(b) + squared), way = root(square(x - a) + square(y - b) + squared);
  return (x * (x - 2 * a) + y * (y - 2 * b)) / (way + far);
}

template <Mask rows, How how, typename C, typename T>
[[gnu::always_inline]] inline auto hologram_at(T x, T y, const C* numbers, const C* change = nullptr) {
  const Entries<T, rows, how, C> n{numbers, change};
  const auto at_x = variable<rows, kX>(x);
  const auto at_y = variable<rows, kY>(y);
  return n.template at<6>() * (from_point<0>(n, at_x, at_y) + from_point<3>(n, at_x, at_y));
}

template <bool second, typename C, typename T, int size>
void hologram(const C* numbers, const T* x, const T* y, int n, Added<T, size>& to) {
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const auto p = hologram_at<second ? kAllRows : kNoRows, kStill>(x[i], y[i], numbers);
    to.p[i] = p.v, to.x[i] = BY(p, kX), to.y[i] = BY(p, kY);
    if constexpr (second) to.xx[i] = BY(p, kX, kX), to.xy[i] = BY(p, kX, kY), to.yy[i] = BY(p, kY, kY);
  }
}

// How the path and its slopes change with the numbers.
template <typename T>
void hologram_change(const T* numbers, const T* change, const T* x, const T* y, int n, Added<T, kBlock>& to) {
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const auto p = hologram_at<kAllRows, kMoved>(x[i], y[i], numbers, change);
    to.p[i] = BY(p, 2), to.x[i] = BY(p, kX, 2), to.y[i] = BY(p, kY, 2);
  }
}

// The path of a form with these numbers.
template <bool second, typename C, typename T, int size>
void path_at(const Layout& at, const C* numbers, const T* x, const T* y, int n, Added<T, size>& to) {
  if (at.phase == kRadial) radial<second>(numbers, at.phase_terms, x, y, n, to);
  else if (at.phase == kFacets) clear(to, n);
  else if (at.phase == kHologram) hologram<second>(numbers, x, y, n, to);
  else with_constant<second>(numbers, at.phase_terms, x, y, n, to);
}

// How it and its slopes change with the numbers; other forms are linear in them.
template <typename T>
void path_change(const Layout& at, const T* numbers, const T* change, const T* x, const T* y, int n, Added<T, kBlock>& to) {
  if (at.phase == kHologram) hologram_change(numbers, change, x, y, n, to);
  else if (at.phase == kFacets) clear(to, n);
  else path_at<false>(at, change, x, y, n, to);
}

// Adds what each number of a polynomial gets from the cotangents p̄, x̄, ȳ of the path and its slopes. `to.q` holds x^k,
// `to.dq` its derivative, `to.xx` and `to.xy` what stands with each of them.
template <typename T>
void sum_polynomial(int count, const T* x, const T* y, const T* gp, const T* gx, const T* gy, int n,
                    Added<T, kBlock>& to, double* sums) {
  const int top = degree(count);
  for (int j = 0; j <= top; j++) {
#pragma omp simd
    for (int i = 0; i < n; i++) {
      const T y_j = j == 0 ? T(1) : to.d2q[i] * y[i], slope = j == 0 ? T(0) : T(j) * to.d2q[i];
      to.d2q[i] = y_j, to.xx[i] = gp[i] * y_j + gy[i] * slope, to.xy[i] = gx[i] * y_j;
      to.q[i] = T(1), to.dq[i] = T(0);
    }
    for (int k = 0; k <= top - j; k++) {
      const int place = place_of(k, j);
      T sum = 0;
#pragma omp simd reduction(+ : sum)
      for (int i = 0; i < n; i++) {
        sum += to.q[i] * to.xx[i] + to.dq[i] * to.xy[i];
        to.dq[i] = T(k + 1) * to.q[i], to.q[i] *= x[i];
      }
      if (k + j > 0 && place < count) sums[place] += sum;
    }
  }
}

// The same behind its constant.
template <typename T>
void sum_with_constant(int count, const T* x, const T* y, const T* gp, const T* gx, const T* gy, int n,
                       Added<T, kBlock>& to, double* sums) {
  T sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int i = 0; i < n; i++) sum += gp[i];
  sums[0] += sum;
  sum_polynomial(count - 1, x, y, gp, gx, gy, n, to, sums + 1);
}

// The same of Σ a_j u^j, whose slope by u has the cotangent 2 (x x̄ + y ȳ).
template <typename T>
void sum_radial(int count, const Rays<T>& at, const T* gp, const T* gx, const T* gy, int n, Notes<T>& notes, double* sums) {
#pragma omp simd
  for (int i = 0; i < n; i++) notes.px[i] = gp[i], notes.py[i] = T(2) * (gx[i] * at.x[i] + gy[i] * at.y[i]);
  sum_series(at, notes, n, count, sums);
}

// And of a hologram, of number j and those behind it.
template <int j = 0, typename T>
void sum_hologram(const T* numbers, const Rays<T>& at, const T* gp, const T* gx, const T* gy, int n, double* sums) {
  T sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int i = 0; i < n; i++) {
    const auto p = hologram_at<kAllRows, kVaried>(at.x[i], at.y[i], numbers);
    sum += BY(p, 2 + j) * gp[i] + BY(p, kX, 2 + j) * gx[i] + BY(p, kY, 2 + j) * gy[i];
  }
  sums[j] += sum;
  if constexpr (j < 6) sum_hologram<j + 1>(numbers, at, gp, gx, gy, n, sums);
}

template <typename T>
void sum_path(const Layout& at, const T* numbers, const Rays<T>& hit, const T* gp, const T* gx, const T* gy, int n,
              Notes<T>& notes, double* sums) {
  if (at.phase == kFacets) return;
  if (at.phase == kHologram) sum_hologram(numbers, hit, gp, gx, gy, n, sums);
  else if (at.phase == kRadial) sum_radial(at.phase_terms, hit, gp, gx, gy, n, notes, sums);
  else sum_with_constant(at.phase_terms, hit.x, hit.y, gp, gx, gy, n, notes.added, sums);
}

}  // namespace raytrace
