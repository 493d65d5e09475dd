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
// the lens, 1 behind it.
template <typename T>
struct Longer {
  T v, px, py, reach, top, length;  // length = top/(reach + 1)
  Longer(T x, T y, T L, T M, T N, T vergence, T sign) {
    v = magnitude(N) * vergence, px = v * x + sign * L, py = v * y + sign * M;
    reach = root(px * px + py * py + N * N);
    top = v * (x * x + y * y) + T(2) * sign * (L * x + M * y);
    length = top / (reach + T(1));
  }
};

// An ideal lens: its powers in x and y, the vergence of the point it images, and that behind it.
template <typename T>
struct IdealLens {
  T n1, n2, power_x, power_y, vergence, onward, cylinder;
  template <typename C>
  IdealLens(T n1, T n2, const C* numbers)
      : n1(n1), n2(n2), power_x(T(numbers[0])), power_y(T(numbers[1])), vergence(T(numbers[2])),
        onward((T(0.5) * (power_x + power_y) - n1 * vergence) / n2), cylinder(T(0.25) * (power_x - power_y)) {}

  // Turns (L, M, N).
  inline void bend(T x, T y, T& L, T& M, T& N) const {
    T steep = magnitude(N), l = n1 * L - power_x * x * steep, m = n1 * M - power_y * y * steep, o = n2 * N;
    T factor = T(1) / root(l * l + m * m + o * o);
    L = l * factor, M = m * factor, N = o * factor;
  }

  // The path that it adds to a ray of direction d before it and e behind it.
  inline T path(T x, T y, T dL, T dM, T dN, T eL, T eM, T eN) const {
    Longer<T> before(x, y, dL, dM, dN, vergence, T(-1)), behind(x, y, eL, eM, eN, onward, T(1));
    return n1 * before.length + n2 * behind.length + cylinder * (x * x - y * y);
  }
};

template <typename T>
int bend_slopes(Rays<T>& rays, Notes<T>& notes, int n, const Surface<T>& s, bool path) {
  const IdealLens<T> lens(s.n1, s.n2, s.phase);
  int flagged = 0;
#pragma omp simd reduction(+ : flagged)
  for (int i = 0; i < n; i++) {
    T x = rays.x[i], y = rays.y[i], L = rays.L[i], M = rays.M[i], N = rays.N[i];
    T l = L, m = M, o = N;
    lens.bend(x, y, l, m, o);
    if (path) rays.path[i] += lens.path(x, y, L, M, N, l, m, o);
    rays.L[i] = l, rays.M[i] = m, rays.N[i] = o;
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
    const IdealLens<double> lens(s.n1, s.n2, numbers);
    const double l = L, m = M, o = N;
    lens.bend(x, y, L, M, N);
    path = lens.path(x, y, l, m, o, L, M, N);
    return true;
  }
  Added<double, 1> added;
  path_at<false>(*s.at, numbers, &x, &y, 1, added);
  if (s.at->phase == kFacets) {
    const double u = x * x + y * y;
    const Facet<double> at(numbers, s.at->phase_terms - kShape, u);
    if (!at.within) return false;
    const double dS = at.dS;
    const double facet[] = {-2 * dS * x, -2 * dS * y, 1};
    path = 0;
    return diffract(s, added, L, M, N, facet, 1 + 4 * dS * dS * u);
  }
  path = added.p[0];
  return diffract(s, added, L, M, N, normal, norm_squared);
}

}  // namespace raytrace
