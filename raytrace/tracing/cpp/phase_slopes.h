// A phase differentiated: its adjoint, and its derivative in a direction, as adjoint.h and tangent.h have them of a surface.
//
// With the path p, g = ∇p, and the symbols there,
//
//     n2 d' = q + α n,   q = n1 d + g,   α = (b - a)/w,   a = q·n,   b = ±√(a² + D w),   D = n2² - n1² - g·(2 n1 d + g)
//     ∂α/∂a = -α/b,   ∂α/∂w = -α²/2b,   ∂α/∂D = 1/2b,   and b = n2 n·d'  (no square root)
#pragma once
#include "adjoint.h"
#include "phases.h"
#include "tangent.h"

namespace raytrace {

// What moves the normal goes to notes.turn, what the numbers get to `row`; the rest is that of the crossing before it.
template <typename T>
void pull_diffract(const Rays<T>& from, const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n,
                   const Surface<T>& s, double* row) {
  Added<T, kBlock>& added = notes.added;
  const Normals<T>& normal = notes.normal;
  Normals<T>& turn = notes.turn;
  path_at<true>(*s.at, s.phase, to.x, to.y, n, added);
  const T n1 = s.n1, n2 = s.n2, over_n2 = T(1) / n2, apart = (n2 - n1) * (n2 + n1);
  T sum_n1 = 0, sum_n2 = 0;
#pragma omp simd reduction(+ : sum_n1, sum_n2)
  for (int i = 0; i < n; i++) {
    T L = from.L[i], M = from.M[i], N = from.N[i], l = to.L[i], m = to.M[i], o = to.N[i];
    T gx = added.x[i], gy = added.y[i], nx = normal.x[i], ny = normal.y[i], nz = normal.z[i], w = normal.w[i];
    T vL = g.L[i] * over_n2, vM = g.M[i] * over_n2, vN = g.N[i] * over_n2;  // of n2 d'
    T qx = n1 * L + gx, qy = n1 * M + gy, qz = n1 * N, a = qx * nx + qy * ny + qz * nz;
    T D = apart - (gx * (qx + n1 * L) + gy * (qy + n1 * M)), b = n2 * (nx * l + ny * m + nz * o), over_b = T(1) / b;
    T along = along_normal(a, b, D, w), v_along = vL * nx + vM * ny + vN * nz;
    T ga = -v_along * along * over_b, gD = T(0.5) * v_along * over_b;
    turn.x[i] = along * vL + ga * qx, turn.y[i] = along * vM + ga * qy, turn.z[i] = along * vN + ga * qz;
    turn.w[i] = -gD * along * along;
    T kx = vL + ga * nx, ky = vM + ga * ny, kz = vN + ga * nz;  // of q
    g.L[i] = n1 * (kx - T(2) * gD * gx), g.M[i] = n1 * (ky - T(2) * gD * gy), g.N[i] = n1 * kz;
    sum_n1 += kx * L + ky * M + kz * N - T(2) * gD * (n1 + gx * L + gy * M);
    sum_n2 += T(2) * n2 * gD - (vL * l + vM * m + vN * o);
    // The slopes of the path depend on where the ray is.
    T bx = kx - T(2) * gD * qx, by = ky - T(2) * gD * qy, R = g.path[i];
    g.x[i] += bx * added.xx[i] + by * added.xy[i] + R * gx;
    g.y[i] += bx * added.xy[i] + by * added.yy[i] + R * gy;
    added.x[i] = bx, added.y[i] = by;
  }
  sum_path(*s.at, s.phase, to, g.path, added.x, added.y, n, notes, row + s.at->phase_numbers);
  row[s.at->before] += sum_n1, row[s.at->behind] += sum_n2;
}

// The merit behind an ideal lens to first order, by the arguments of `bent`.
template <typename T, typename... Of>
[[gnu::always_inline]] inline auto merit_by(T gl, T gm, T gn, T gp, const Of&... of) {
  return bent<T>(of..., [=](const auto& l, const auto& m, const auto& n, const auto& path) {
    return gl * l + gm * m + gn * n + gp * path;
  });
}

// How a ray behind it changes.
template <typename T, typename... Of>
[[gnu::always_inline]] inline Behind<T> change_by(const Of&... of) {
  return bent<T>(of..., [](const auto& l, const auto& m, const auto& n, const auto& path) {
    return Behind<T>{l.d[0], m.d[0], n.d[0], path.d[0]};
  });
}

template <typename T>
void pull_slopes(const Rays<T>& from, const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n, const Surface<T>& s,
                 double* row) {
  enum { x, y, L, M, N, n1, n2, power_x, power_y, vergence };
  const auto before = variable<0, n1>(s.n1);
  const auto behind = variable<0, n2>(s.n2);
  const auto along_x = variable<0, power_x>(s.phase[0]);
  const auto along_y = variable<0, power_y>(s.phase[1]);
  const auto imaged = variable<0, vergence>(s.phase[2]);
  Normals<T>& turn = notes.turn;
  T sum_n1 = 0, sum_n2 = 0, sum_x = 0, sum_y = 0, sum_v = 0;
#pragma omp simd reduction(+ : sum_n1, sum_n2, sum_x, sum_y, sum_v)
  for (int i = 0; i < n; i++) {
    const auto merit = merit_by(g.L[i], g.M[i], g.N[i], g.path[i], variable<0, x>(to.x[i]), variable<0, y>(to.y[i]),
                                variable<0, L>(from.L[i]), variable<0, M>(from.M[i]), variable<0, N>(from.N[i]), before,
                                behind, along_x, along_y, imaged);
    g.x[i] += merit.d[x], g.y[i] += merit.d[y], g.L[i] = merit.d[L], g.M[i] = merit.d[M], g.N[i] = merit.d[N];
    sum_n1 += merit.d[n1], sum_n2 += merit.d[n2];
    sum_x += merit.d[power_x], sum_y += merit.d[power_y], sum_v += merit.d[vergence];
    turn.x[i] = turn.y[i] = turn.z[i] = turn.w[i] = 0;
  }
  double* numbers = row + s.at->phase_numbers;
  numbers[0] += sum_x, numbers[1] += sum_y, numbers[2] += sum_v;
  row[s.at->before] += sum_n1, row[s.at->behind] += sum_n2;
}

template <typename T>
void pull_phase(const Rays<T>& from, const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n,
                const Surface<T>& s, double* row) {
  if (s.at->phase == kSlopes) return pull_slopes(from, to, g, notes, n, s, row);
  pull_diffract(from, to, g, notes, n, s, row);
  if (s.at->phase == kFacets) pull_facets(to, g, notes, n, s, row + s.at->phase_numbers);
}

// Forward; d: the changes of the hit, and of the rays before the surface elsewhere; notes.turn: those of the normal.
template <typename T>
void push_diffract(const Rays<T>& from, const Rays<T>& to, Rays<T>& d, Notes<T>& notes, int n, const Surface<T>& s,
                   const Change<T>& change, bool path) {
  const Normals<T>& normal = notes.normal;
  const Normals<T>& turn = notes.turn;
  Added<T, kBlock>& added = notes.added;
  const T n1 = s.n1, n2 = s.n2, dn1 = change.n1, dn2 = change.n2, over_n2 = T(1) / n2, apart = (n2 - n1) * (n2 + n1);
  // What its numbers do to the path, kept in arrays that the path itself leaves alone.
  path_change(*s.at, s.phase, change.phase, to.x, to.y, n, added);
  T *dp = notes.px, *dpx = notes.py, *dpy = notes.pz;
  for (int i = 0; i < n; i++) dp[i] = added.p[i], dpx[i] = added.x[i], dpy[i] = added.y[i];
  path_at<true>(*s.at, s.phase, to.x, to.y, n, added);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T L = from.L[i], M = from.M[i], N = from.N[i], l = to.L[i], m = to.M[i], o = to.N[i];
    T gx = added.x[i], gy = added.y[i], nx = normal.x[i], ny = normal.y[i], nz = normal.z[i], w = normal.w[i];
    T dx = d.x[i], dy = d.y[i], dL = d.L[i], dM = d.M[i], dN = d.N[i];
    T tx = dpx[i] + added.xx[i] * dx + added.xy[i] * dy, ty = dpy[i] + added.xy[i] * dx + added.yy[i] * dy;
    T qx = n1 * L + gx, qy = n1 * M + gy, qz = n1 * N, a = qx * nx + qy * ny + qz * nz;
    T kx = dn1 * L + n1 * dL + tx, ky = dn1 * M + n1 * dM + ty, kz = dn1 * N + n1 * dN;
    T D = apart - (gx * (qx + n1 * L) + gy * (qy + n1 * M)), b = n2 * (nx * l + ny * m + nz * o);
    T along = along_normal(a, b, D, w);
    T da = kx * nx + ky * ny + kz * nz + qx * turn.x[i] + qy * turn.y[i] + qz * turn.z[i];
    T half_dD = n2 * dn2 - n1 * dn1 - dn1 * (gx * L + gy * M) - n1 * (gx * dL + gy * dM) - (qx * tx + qy * ty);
    T dalong = (half_dD - along * da - T(0.5) * along * along * turn.w[i]) / b;
    d.L[i] = (kx + dalong * nx + along * turn.x[i] - dn2 * l) * over_n2;
    d.M[i] = (ky + dalong * ny + along * turn.y[i] - dn2 * m) * over_n2;
    d.N[i] = (kz + dalong * nz + along * turn.z[i] - dn2 * o) * over_n2;
    if (path) d.path[i] += dp[i] + gx * dx + gy * dy;
  }
}

template <typename T>
void push_slopes(const Rays<T>& from, const Rays<T>& to, Rays<T>& d, Notes<T>&, int n, const Surface<T>& s,
                 const Change<T>& change, bool path) {
  const auto before = variable<0, 0>(s.n1, change.n1);
  const auto behind = variable<0, 0>(s.n2, change.n2);
  const auto power_x = variable<0, 0>(s.phase[0], change.phase[0]);
  const auto power_y = variable<0, 0>(s.phase[1], change.phase[1]);
  const auto vergence = variable<0, 0>(s.phase[2], change.phase[2]);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const auto of = change_by<T>(variable<0, 0>(to.x[i], d.x[i]), variable<0, 0>(to.y[i], d.y[i]),
                                 variable<0, 0>(from.L[i], d.L[i]), variable<0, 0>(from.M[i], d.M[i]),
                                 variable<0, 0>(from.N[i], d.N[i]), before, behind, power_x, power_y, vergence);
    d.L[i] = of.l, d.M[i] = of.m, d.N[i] = of.n;
    if (path) d.path[i] += of.path;
  }
}

template <typename T>
void push_phase(const Rays<T>& from, const Rays<T>& to, Rays<T>& d, Notes<T>& notes, int n, const Surface<T>& s,
                const Change<T>& change, bool path) {
  if (s.at->phase == kSlopes) return push_slopes(from, to, d, notes, n, s, change, path);
  if (s.at->phase == kFacets) push_facets(to, d, notes, n, s, change.phase);
  push_diffract(from, to, d, notes, n, s, change, path);
}

}  // namespace raytrace
