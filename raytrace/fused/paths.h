// Paths p(x, y) that a phase adds, with their derivatives, over a block or at one point: raytrace/system/phases.py.
//
//     polynomial  Σ c_k x^i y^j in the order x, y, x², xy, y², x³, …        radial  Σ a_j u^j, u = r², j = 1, 2, …
//
// A new form is one more `Form`, in the order of FORMS in structure.py, and a case of `add_path` and `sum_path`.
#pragma once
#include "block.h"

namespace raytrace {

enum Form { kNoPhase, kPolynomial, kRadial, kSlopes };

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

// Horner's rule in y over polynomials in x, each with its first derivative, and with the second if asked for.
template <bool second, typename C, typename T, int size>
void polynomial(const C* c, int count, const T* x, const T* y, int n, Added<T, size>& to) {
  clear(to, n);
  if (count <= 2) {
    const T a = count > 0 ? T(c[0]) : T(0), b = count > 1 ? T(c[1]) : T(0);
#pragma omp simd
    for (int i = 0; i < n; i++) to.p[i] = a * x[i] + b * y[i], to.x[i] = a, to.y[i] = b;
    return;
  }
  const int top = degree(count);
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

// The path of a form with these numbers.
template <bool second, typename C, typename T, int size>
void path_at(const Layout& at, const C* numbers, const T* x, const T* y, int n, Added<T, size>& to) {
  if (at.phase == kRadial) radial<second>(numbers, at.phase_terms, x, y, n, to);
  else polynomial<second>(numbers, at.phase_terms, x, y, n, to);
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

// The same of Σ a_j u^j.
template <typename T>
void sum_radial(int count, const Rays<T>& at, const T* gp, const T* gx, const T* gy, int n, Added<T, kBlock>& to,
                double* sums) {
  for (int i = 0; i < n; i++) to.q[i] = 1;
  for (int j = 0; j < count; j++) {
    T sum = 0;
#pragma omp simd reduction(+ : sum)
    for (int i = 0; i < n; i++) {
      const T u = at.x[i] * at.x[i] + at.y[i] * at.y[i];
      sum += to.q[i] * (gp[i] * u + T(2 * (j + 1)) * (gx[i] * at.x[i] + gy[i] * at.y[i]));
      to.q[i] *= u;
    }
    sums[j] += sum;
  }
}

template <typename T>
void sum_path(const Layout& at, const Rays<T>& hit, const T* gp, const T* gx, const T* gy, int n, Added<T,
              kBlock>& to, double* sums) {
  if (at.phase == kRadial) sum_radial(at.phase_terms, hit, gp, gx, gy, n, to, sums);
  else sum_polynomial(at.phase_terms, hit.x, hit.y, gp, gx, gy, n, to, sums);
}

}  // namespace raytrace
