// What a sag has beside its conic and even terms, by powers of x and y about a centre: `PowerSag` of raytrace/system/sag_terms.py.
//
//     D = c_0 + Σ c_k u^i v^j,   u = (x - x_0)/R,   v = (y - y_0)/R,   in the order of paths.h
//
// Its numbers are x_0, y_0, R, c_0, and then the c_k. A loop over rays finds D of a whole block first: see `Added`.
#pragma once
#include "paths.h"
#include "sags.h"

namespace raytrace {

constexpr int kFrame = 4;  // numbers before the c_k

// From points to u and v.
template <typename T>
struct Frame {
  T x, y, over;
  template <typename C>
  explicit Frame(const C* numbers) : x(T(numbers[0])), y(T(numbers[1])), over(T(1) / T(numbers[2])) {}
};

// D and its derivatives by x and y at the points u, v.
template <bool second, typename T, int size>
void sag_terms_at(const Surface<T>& s, int n, Added<T, size>& to) {
  polynomial<second>(s.sag_terms + kFrame, s.at->sag_term_count, to.u, to.v, n, to);
  const T over = Frame<T>(s.sag_terms).over, height = s.sag_terms[3];
#pragma omp simd
  for (int i = 0; i < n; i++) {
    to.p[i] += height, to.x[i] *= over, to.y[i] *= over;
    if (second) to.xx[i] *= over * over, to.xy[i] *= over * over, to.yy[i] *= over * over;
  }
}

// The same where rays stand.
template <bool second, typename T>
void sag_terms_on(const Rays<T>& at, Notes<T>& notes, int n, const Surface<T>& s) {
  const Frame<T> frame(s.sag_terms);
  Added<T, kBlock>& to = notes.added;
#pragma omp simd
  for (int i = 0; i < n; i++) to.u[i] = (at.x[i] - frame.x) * frame.over, to.v[i] = (at.y[i] - frame.y) * frame.over;
  sag_terms_at<second>(s, n, to);
}

// And where they are at the paths that Newton's method has come to.
template <typename T>
void sag_terms_along(const Rays<T>& from, Notes<T>& notes, int n, const Surface<T>& s) {
  const Frame<T> frame(s.sag_terms);
  Added<T, kBlock>& to = notes.added;
#pragma omp simd
  for (int i = 0; i < n; i++) {
    to.u[i] = (notes.px[i] + notes.t[i] * from.L[i] - frame.x) * frame.over;
    to.v[i] = (notes.py[i] + notes.t[i] * from.M[i] - frame.y) * frame.over;
  }
  sag_terms_at<false>(s, n, to);
}

// One point.
inline Added<double, 1> sag_terms_at(const Surface<double>& s, double x, double y) {
  const Frame<double> frame(s.sag_terms);
  Added<double, 1> found;
  found.u[0] = (x - frame.x) * frame.over, found.v[0] = (y - frame.y) * frame.over;
  sag_terms_at<false>(s, 1, found);
  return found;
}

// The sag of a kind at a point with its sag terms, which `added` holds in place i.
template <int kind, int size, How how, Mask rows, typename T, int count>
[[gnu::always_inline]] inline auto whole_sag_at(const Surface<T>& s, const Added<T, count>& added, int i, T x, T y,
                                                const Change<T>* change = nullptr) {
  const auto S = sag_at<kind, size, how, rows>(s, x, y, change);
  if constexpr (!has_sag_terms(kind)) {
    return S;
  } else {
    constexpr int xx = place_of_pair(kX, kX), xy = place_of_pair(kX, kY), yy = place_of_pair(kY, kY);
    Jet<T, rows, 3, pairs_of(rows, 3, 3)> D;
    D.v = added.p[i], D.d[kX] = added.x[i], D.d[kY] = added.y[i];
    if constexpr (rows != 0) D.h[xx] = added.xx[i], D.h[xy] = added.xy[i], D.h[yy] = added.yy[i];
    return S + D;
  }
}

// F at a point of a surface, whose slopes are the normal: z less its sag, or half of its quadric, negative.
template <int kind, int size, How how, Mask rows, typename T, int count>
[[gnu::always_inline]] inline auto face_at(const Surface<T>& s, const Added<T, count>& added, int i, T x, T y, T z,
                                           const Change<T>* change = nullptr) {
  const auto height = variable<rows, kZ>(z);
  if constexpr (kind == kPlane) {
    return height;
  } else if constexpr (is_searched(kind)) {
    return height - whole_sag_at<kind, size, how, rows>(s, added, i, x, y, change);
  } else {
    const Numbers<T, rows, how, 0> numbers{s, change};
    const auto across = square(variable<rows, kX>(x)) + square(variable<rows, kY>(y));
    const auto half = 0.5 * numbers.c();
    if constexpr (kind == kSphere) return height - half * (across + square(height));
    else return height - half * (across + (1 + numbers.k()) * square(height));
  }
}

// Bounds on |D| and on its slope up to a radius.
template <typename T>
T sag_terms_bound(const Surface<T>& s, T radius, bool slope) {
  const T* numbers = s.sag_terms;
  const T over = T(1) / magnitude(numbers[2]), reach = (radius + magnitude(numbers[0]) + magnitude(numbers[1])) * over;
  const int count = s.at->sag_term_count;
  T total = slope ? T(0) : magnitude(numbers[3]), power = slope ? over : reach;
  for (int n = 1, k = 0; k < count; n++, power *= reach)
    for (int j = 0; j <= n && k < count; j++, k++) total += T(slope ? n : 1) * magnitude(numbers[kFrame + k]) * power;
  return total;
}
template <typename T>
T sag_terms_size(const Surface<T>& s, T radius) { return sag_terms_bound(s, radius, false); }
template <typename T>
T sag_terms_slope(const Surface<T>& s, T radius) { return sag_terms_bound(s, radius, true); }

// What the numbers get from the cotangents z̄ of the sag, in notes.px, and x̄, ȳ of its slopes, in notes.t and notes.active;
// D of the block stands in notes.added with its second derivatives.
template <typename T>
void sum_sag_terms(Notes<T>& notes, int n, const Surface<T>& s, double* row) {
  Added<T, kBlock>& at = notes.added;
  const T over = Frame<T>(s.sag_terms).over;
  T sum_x = 0, sum_y = 0, sum_radius = 0, sum_height = 0;
#pragma omp simd reduction(+ : sum_x, sum_y, sum_radius, sum_height)
  for (int i = 0; i < n; i++) {
    T gz = notes.px[i], gx = notes.t[i], gy = notes.active[i];
    T bx = gz * at.x[i] + gx * at.xx[i] + gy * at.xy[i], by = gz * at.y[i] + gx * at.xy[i] + gy * at.yy[i];
    sum_x -= bx, sum_y -= by, sum_height += gz;
    sum_radius -= bx * at.u[i] + by * at.v[i] + (gx * at.x[i] + gy * at.y[i]) * over;
    notes.t[i] = gx * over, notes.active[i] = gy * over;
  }
  double* own = row + s.at->sag_term_numbers;
  own[0] += sum_x, own[1] += sum_y, own[2] += sum_radius, own[3] += sum_height;
  sum_polynomial(s.at->sag_term_count, at.u, at.v, notes.px, notes.t, notes.active, n, at, own + kFrame);
}

// How D and its slopes change with the numbers where rays stand, in notes.px, notes.py and notes.pz; notes.added: D itself.
template <typename T>
void sag_terms_change(const Rays<T>& at, Notes<T>& notes, int n, const Surface<T>& s, const T* change) {
  const T over = Frame<T>(s.sag_terms).over, dx = change[0], dy = change[1], dR = change[2], dheight = change[3];
  sag_terms_on<false>(at, notes, n, s);  // u and v
  Added<T, kBlock>& to = notes.added;
  polynomial<false>(change + kFrame, s.at->sag_term_count, to.u, to.v, n, to);
  for (int i = 0; i < n; i++) notes.px[i] = to.p[i], notes.py[i] = to.x[i], notes.pz[i] = to.y[i];
  sag_terms_at<true>(s, n, to);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T across = dx + dR * to.u[i], along = dy + dR * to.v[i];  // how much less the point is than the centre's, by R
    notes.px[i] += dheight - (to.x[i] * across + to.y[i] * along);
    notes.py[i] = notes.py[i] * over - (to.xx[i] * across + to.xy[i] * along + to.x[i] * dR * over);
    notes.pz[i] = notes.pz[i] * over - (to.xy[i] * across + to.yy[i] * along + to.y[i] * dR * over);
  }
}

}  // namespace raytrace
