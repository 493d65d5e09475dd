// Paths p(x, y) that a phase adds, with their derivatives, over a block or at one point: raytrace/system/phases.py.
//
//     polynomial  c + Σ c_k x^i y^j in the order x, y, x², xy, y², x³, …    radial  Σ a_j u^j, u = r², j = 1, 2, …
//     hologram    s Σ (|P - Q| - |Q|) over two points Q = (a, b, c); the numbers are theirs, and s
//
// A new form is one more `Form`, in the order of FORMS in structure.py, and a case of `path_at`, `path_change` and `sum_path`.
#pragma once
#include "block.h"

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

// The way from one point of a hologram to P: its direction e, and how much longer it is than to the vertex.
template <typename T>
struct FromPoint {
  T x, y, z, over, longer;  // over: 1/|P - Q|
  FromPoint(T a, T b, T c, T far, T px, T py) {
    T dx = px - a, dy = py - b, r = root(dx * dx + dy * dy + c * c);
    over = T(1) / r, x = dx * over, y = dy * over, z = -c * over;
    longer = (px * (px - T(2) * a) + py * (py - T(2) * b)) / (r + far);
  }
};

template <bool second, typename C, typename T, int size>
void hologram(const C* numbers, const T* x, const T* y, int n, Added<T, size>& to) {
  clear(to, n);
  const T s = T(numbers[6]);
  for (int point = 0; point < 2; point++, numbers += 3) {
    const T a = T(numbers[0]), b = T(numbers[1]), c = T(numbers[2]), far = root(a * a + b * b + c * c);
#pragma omp simd
    for (int i = 0; i < n; i++) {
      const FromPoint<T> e(a, b, c, far, x[i], y[i]);
      to.p[i] += s * e.longer, to.x[i] += s * e.x, to.y[i] += s * e.y;
      if (second) {
        to.xx[i] += s * (T(1) - e.x * e.x) * e.over, to.yy[i] += s * (T(1) - e.y * e.y) * e.over;
        to.xy[i] -= s * e.x * e.y * e.over;
      }
    }
  }
}

// How the path and its slopes change with the numbers.
template <typename T>
void hologram_change(const T* numbers, const T* change, const T* x, const T* y, int n, Added<T, kBlock>& to) {
  clear(to, n);
  const T s = numbers[6], ds = change[6];
  for (int point = 0; point < 2; point++, numbers += 3, change += 3) {
    const T a = numbers[0], b = numbers[1], c = numbers[2], da = change[0], db = change[1], dc = change[2];
    const T far = root(a * a + b * b + c * c), further = (a * da + b * db + c * dc) / far;
#pragma omp simd
    for (int i = 0; i < n; i++) {
      const FromPoint<T> e(a, b, c, far, x[i], y[i]);
      const T along = e.x * da + e.y * db + e.z * dc;
      to.p[i] += ds * e.longer - s * (along + further);
      to.x[i] += ds * e.x + s * e.over * (e.x * along - da);
      to.y[i] += ds * e.y + s * e.over * (e.y * along - db);
    }
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

// And of a hologram.
template <typename T>
void sum_hologram(const T* numbers, const Rays<T>& at, const T* gp, const T* gx, const T* gy, int n, double* sums) {
  const T s = numbers[6];
  T sum_s = 0;
  for (int point = 0; point < 2; point++, numbers += 3, sums += 3) {
    const T a = numbers[0], b = numbers[1], c = numbers[2], far = root(a * a + b * b + c * c);
    T sum_a = 0, sum_b = 0, sum_c = 0, sum_p = 0;
#pragma omp simd reduction(+ : sum_a, sum_b, sum_c, sum_p, sum_s)
    for (int i = 0; i < n; i++) {
      const FromPoint<T> e(a, b, c, far, at.x[i], at.y[i]);
      const T turn = (gx[i] * e.x + gy[i] * e.y) * e.over, along = turn - gp[i];
      sum_a += e.x * along - gx[i] * e.over, sum_b += e.y * along - gy[i] * e.over, sum_c += e.z * along;
      sum_p += gp[i], sum_s += gp[i] * e.longer + gx[i] * e.x + gy[i] * e.y;
    }
    const T each = sum_p / far;
    sums[0] += s * (sum_a - each * a), sums[1] += s * (sum_b - each * b), sums[2] += s * (sum_c - each * c);
  }
  sums[0] += sum_s;
}

template <typename T>
void sum_path(const Layout& at, const T* numbers, const Rays<T>& hit, const T* gp, const T* gx, const T* gy, int n,
              Added<T, kBlock>& to, double* sums) {
  if (at.phase == kFacets) return;
  if (at.phase == kHologram) sum_hologram(numbers, hit, gp, gx, gy, n, sums);
  else if (at.phase == kRadial) sum_radial(at.phase_terms, hit, gp, gx, gy, n, to, sums);
  else sum_with_constant(at.phase_terms, hit.x, hit.y, gp, gx, gy, n, to, sums);
}

}  // namespace raytrace
