// What a phase on a surface does to light there: raytrace/optics/trace.py, `diffract` and `bend_slopes`, and the path through
// an ideal lens of raytrace/system/phases.py. Where rays meet the surface is the business of loops.h.
#pragma once
#include "facets.h"
#include "paths.h"

namespace raytrace {

// α of a ray; b has the sign of `side` (n·d).
template <typename T>
inline T along_normal(T a, T b, T D, T w) {
  const bool alike = a * b > 0;
  return alike ? D / (alike ? a + b : T(1)) : (b - a) / w;
}

// Turns the rays that stand at a surface, in place; returns how many it flags.
template <typename T>
int diffract(Rays<T>& rays, Notes<T>& notes, int n, const Surface<T>& s, bool path) {
  path_at<false>(*s.at, s.phase, rays.x, rays.y, n, notes.added);
  const Normals<T>& normal = notes.normal;
  const Added<T, kBlock>& added = notes.added;
  const T n1 = s.n1, n2 = s.n2, over_n2 = T(1) / n2, apart = (n2 - n1) * (n2 + n1);
  const T side = s.at->bend == kReflect ? T(-1) : T(1);
  const bool has_index = n2 > 0;
  int flagged = 0;
#pragma omp simd reduction(+ : flagged)
  for (int i = 0; i < n; i++) {
    T L = rays.L[i], M = rays.M[i], N = rays.N[i], gx = added.x[i], gy = added.y[i];
    T nx = normal.x[i], ny = normal.y[i], nz = normal.z[i], w = normal.w[i];
    T cosine = nx * L + ny * M + nz * N, a = n1 * cosine + gx * nx + gy * ny;
    T D = apart - (gx * (T(2) * n1 * L + gx) + gy * (T(2) * n1 * M + gy)), b_squared = a * a + D * w;
    bool passes = (b_squared > kCritical<T>) & has_index;
    T along = along_normal(a, signed_as(root(passes ? b_squared : T(1)), side * cosine), D, w);
    T l = (n1 * L + gx + along * nx) * over_n2, m = (n1 * M + gy + along * ny) * over_n2;
    T o = (n1 * N + along * nz) * over_n2;
    T factor = T(1.5) - T(0.5) * (l * l + m * m + o * o);
    rays.L[i] = l * factor, rays.M[i] = m * factor, rays.N[i] = o * factor;
    bool good = passes & (notes.flagged[i] == 0);
    notes.flagged[i] = good ? T(0) : T(1);
    flagged += good ? 0 : 1;
  }
  if (path)
    for (int i = 0; i < n; i++) rays.path[i] += added.p[i];
  return flagged;
}

// One ray of the same in float64; false where no light passes.
inline bool diffract(const Surface<double>& s, const Added<double, 1>& added, double& L, double& M, double& N,
                     const double* n, double w) {
  const double n1 = s.n1, n2 = s.n2, gx = added.x[0], gy = added.y[0];
  const double cosine = n[0] * L + n[1] * M + n[2] * N, a = n1 * cosine + gx * n[0] + gy * n[1];
  const double D = (n2 - n1) * (n2 + n1) - (gx * (2 * n1 * L + gx) + gy * (2 * n1 * M + gy)), b_squared = a * a + D * w;
  if (!(b_squared > 0) || !(n2 > 0)) return false;
  const double b = signed_as(std::sqrt(b_squared), s.at->bend == kReflect ? -cosine : cosine);
  const double along = along_normal(a, b, D, w);
  L = (n1 * L + gx + along * n[0]) / n2, M = (n1 * M + gy + along * n[1]) / n2, N = (n1 * N + along * n[2]) / n2;
  return true;
}

// How much longer the way from the vertex to a point on the ray is than the ray's own; v: inverse distance, sign: -1 before
// the lens, 1 behind it. Any number type, as below.
template <typename T, typename X, typename Y, typename L, typename M, typename N, typename V>
[[gnu::always_inline]] inline auto longer(const X& x, const Y& y, const L& l, const M& m, const N& n, const V& vergence,
                                          int sign) {
  const auto v = magnitude(n) * vergence;
  const auto px = v * x + T(sign) * l;
  const auto py = v * y + T(sign) * m;
  return (v * (x * x + y * y) + T(2 * sign) * (l * x + m * y)) * inverse(T(1) + root(px * px + py * py + n * n));
}

// Calls work(l, m, n, path) with the direction of a ray behind an ideal lens and the path that it adds; power: φx, φy;
// vergence: of the point that it images.
template <typename T, typename X, typename Y, typename L, typename M, typename N, typename A, typename B, typename U,
          typename W, typename V, typename Work>
[[gnu::always_inline]] inline auto bent(const X& x, const Y& y, const L& l, const M& m, const N& n, const A& n1, const B& n2,
                                        const U& power_x, const W& power_y, const V& vergence, Work work) {
  const auto steep = magnitude(n);
  const auto e = n1 * l - power_x * x * steep;
  const auto f = n1 * m - power_y * y * steep;
  const auto g = n2 * n;
  const auto factor = inverse(root(e * e + f * f + g * g));
  const auto onward = (T(0.5) * (power_x + power_y) - n1 * vergence) * inverse(n2);
  const auto behind_x = e * factor;
  const auto behind_y = f * factor;
  const auto behind_z = g * factor;
  return work(behind_x, behind_y, behind_z,
              n1 * longer<T>(x, y, l, m, n, vergence, -1) + n2 * longer<T>(x, y, behind_x, behind_y, behind_z, onward, 1) +
                  T(0.25) * (power_x - power_y) * (x * x - y * y));
}

template <typename T>
struct Behind { T l, m, n, path; };

template <typename T>
[[gnu::always_inline]] inline Behind<T> behind_ideal(T x, T y, T l, T m, T n, T n1, T n2, T power_x, T power_y, T vergence) {
  return bent<T>(x, y, l, m, n, n1, n2, power_x, power_y, vergence,
                 [](T l, T m, T n, T path) { return Behind<T>{l, m, n, path}; });
}

template <typename T>
int bend_slopes(Rays<T>& rays, Notes<T>& notes, int n, const Surface<T>& s, bool path) {
  const T power_x = s.phase[0], power_y = s.phase[1], vergence = s.phase[2];
  int flagged = 0;
#pragma omp simd reduction(+ : flagged)
  for (int i = 0; i < n; i++) {
    const auto to = behind_ideal(rays.x[i], rays.y[i], rays.L[i], rays.M[i], rays.N[i], s.n1, s.n2, power_x, power_y,
                                 vergence);
    if (path) rays.path[i] += to.path;
    rays.L[i] = to.l, rays.M[i] = to.m, rays.N[i] = to.n;
    flagged += notes.flagged[i] == 0 ? 0 : 1;
  }
  return flagged;
}

// Rays that stand at a surface with a phase, behind it; returns how many are flagged.
template <typename T>
int through_phase(Rays<T>& rays, Notes<T>& notes, int n, const Surface<T>& s, bool path) {
  return s.at->phase == kSlopes ? bend_slopes(rays, notes, n, s, path) : diffract(rays, notes, n, s, path);
}

// One ray at a surface, in float64: (L, M, N) behind it and the path that is added; false where no light passes.
template <typename C>
bool through_phase(const Surface<double>& s, const C* numbers, double x, double y, double& L, double& M, double& N,
                   const double* normal, double norm_squared, double& path) {
  if (s.at->phase == kSlopes) {
    const double power_x = numbers[0], power_y = numbers[1], vergence = numbers[2];
    const auto to = behind_ideal(x, y, L, M, N, s.n1, s.n2, power_x, power_y, vergence);
    L = to.l, M = to.m, N = to.n, path = to.path;
    return true;
  }
  Added<double, 1> added;
  path_at<false>(*s.at, numbers, &x, &y, 1, added);
  if (s.at->phase == kFacets) {
    const double u = x * x + y * y;
    const auto S = facet_at<kStill, kNoRows>(facets_of<Surface>(s, numbers), u);
    if (!S.inside) return false;
    const double dS = S.d[kX];
    const double facet[] = {-2 * dS * x, -2 * dS * y, 1};
    path = 0;
    return diffract(s, added, L, M, N, facet, 1 + 4 * dS * dS * u);
  }
  path = added.p[0];
  return diffract(s, added, L, M, N, normal, norm_squared);
}

}  // namespace raytrace
