// A phase differentiated: its adjoint, and its derivative in a direction, as adjoint.h and tangent.h have them of a surface.
//
// With the path p, g = ∇p, and the symbols there,
//
//     n2 d' = q + α n,   q = n1 d + g,   α = (b - a)/w,   a = q·n,   b = ±√(a² + D w),   D = n2² - n1² - g·(2 n1 d + g)
//     ∂α/∂a = -α/b,   ∂α/∂w = -α²/2b,   ∂α/∂D = 1/2b,   and b = n2 n·d'  (no square root)
//
// An ideal lens has d' = e/|e|, e = (n1 L - φx x |N|, n1 M - φy y |N|, n2 N), so that ē = (d̄' - d' (d'·d̄'))/|e|.
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
  sum_path(*s.at, s.phase, to, g.path, added.x, added.y, n, added, row + s.at->phase_numbers);
  row[s.at->before] += sum_n1, row[s.at->behind] += sum_n2;
}

// From the cotangent e of what `Longer` is to those of its arguments.
template <typename T>
inline void pull_longer(const Longer<T>& of, T e, T x, T y, T N, T vergence, T sign, T& gx, T& gy, T& gL, T& gM,
                        T& gN, T& gv) {
  T over = T(1) / (of.reach + T(1)), top = e * over, reach = -e * of.length * over / of.reach;
  T by_px = reach * of.px, by_py = reach * of.py, by_v = top * (x * x + y * y) + by_px * x + by_py * y;
  gx += T(2) * top * of.px + of.v * by_px, gy += T(2) * top * of.py + of.v * by_py;
  gL += sign * (T(2) * top * x + by_px), gM += sign * (T(2) * top * y + by_py);
  gN += reach * N + signed_as(by_v * vergence, N), gv += by_v * magnitude(N);
}

template <typename T>
void pull_slopes(const Rays<T>& from, const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n,
                 const Surface<T>& s, double* row) {
  const IdealLens<T> lens(s.n1, s.n2, s.phase);
  const T n1 = s.n1, n2 = s.n2;
  Normals<T>& turn = notes.turn;
  T sum_n1 = 0, sum_n2 = 0, sum_x = 0, sum_y = 0, sum_v = 0, sum_onward = 0;
#pragma omp simd reduction(+ : sum_n1, sum_n2, sum_x, sum_y, sum_v, sum_onward)
  for (int i = 0; i < n; i++) {
    T x = to.x[i], y = to.y[i], L = from.L[i], M = from.M[i], N = from.N[i], l = to.L[i], m = to.M[i], o = to.N[i];
    T gx = 0, gy = 0, gL = 0, gM = 0, gN = 0, gl = g.L[i], gm = g.M[i], gn = g.N[i], gv = 0, gonward = 0, R = g.path[i];

    // The path.
    Longer<T> before(x, y, L, M, N, lens.vergence, T(-1)), behind(x, y, l, m, o, lens.onward, T(1));
    T quarter = T(0.25) * R * (x * x - y * y);
    pull_longer(before, n1 * R, x, y, N, lens.vergence, T(-1), gx, gy, gL, gM, gN, gv);
    pull_longer(behind, n2 * R, x, y, o, lens.onward, T(1), gx, gy, gl, gm, gn, gonward);
    gx += T(2) * R * lens.cylinder * x, gy -= T(2) * R * lens.cylinder * y;

    // The direction.
    T steep = magnitude(N), eL = n1 * L - lens.power_x * x * steep, eM = n1 * M - lens.power_y * y * steep, eN = n2 * N;
    T over = T(1) / root(eL * eL + eM * eM + eN * eN), both = l * gl + m * gm + o * gn;
    T kL = (gl - both * l) * over, kM = (gm - both * m) * over, kN = (gn - both * o) * over;
    T bent = -(lens.power_x * x * kL + lens.power_y * y * kM);
    g.L[i] = gL + n1 * kL, g.M[i] = gM + n1 * kM, g.N[i] = gN + n2 * kN + signed_as(bent, N);
    g.x[i] += gx - lens.power_x * steep * kL, g.y[i] += gy - lens.power_y * steep * kM;
    sum_x += quarter - x * steep * kL, sum_y -= quarter + y * steep * kM;
    sum_n1 += R * before.length + L * kL + M * kM, sum_n2 += R * behind.length + N * kN;
    sum_v += gv, sum_onward += gonward;
    turn.x[i] = turn.y[i] = turn.z[i] = turn.w[i] = 0;
  }
  const T each = sum_onward / n2;  // onward = ((φx + φy)/2 - n1 v)/n2
  double* own = row + s.at->phase_numbers;
  own[0] += sum_x + T(0.5) * each, own[1] += sum_y + T(0.5) * each, own[2] += sum_v - n1 * each;
  row[s.at->before] += sum_n1 - lens.vergence * each, row[s.at->behind] += sum_n2 - lens.onward * each;
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

// How the length of a `Longer` changes.
template <typename T>
inline T push_longer(const Longer<T>& of, T x, T y, T N, T vergence, T sign, T L, T M, T dx, T dy, T dL, T dM, T dN,
                     T dvergence) {
  T dv = magnitude(N) * dvergence + signed_as(dN * vergence, N);
  T dpx = dv * x + of.v * dx + sign * dL, dpy = dv * y + of.v * dy + sign * dM;
  T dreach = (of.px * dpx + of.py * dpy + N * dN) / of.reach;
  T dtop = dv * (x * x + y * y) + T(2) * (of.v * (x * dx + y * dy) + sign * (L * dx + M * dy + x * dL + y * dM));
  return (dtop - of.length * dreach) / (of.reach + T(1));
}

template <typename T>
void push_slopes(const Rays<T>& from, const Rays<T>& to, Rays<T>& d, Notes<T>&, int n, const Surface<T>& s,
                 const Change<T>& change, bool path) {
  const IdealLens<T> lens(s.n1, s.n2, s.phase);
  const T n1 = s.n1, n2 = s.n2, dn1 = change.n1, dn2 = change.n2;
  const T power_x = lens.power_x, power_y = lens.power_y;
  const T dpower_x = change.phase[0], dpower_y = change.phase[1], dv = change.phase[2];
  const T dcylinder = T(0.25) * (dpower_x - dpower_y);
  const T donward = (T(0.5) * (dpower_x + dpower_y) - n1 * dv - dn1 * lens.vergence - lens.onward * dn2) / n2;
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T x = to.x[i], y = to.y[i], L = from.L[i], M = from.M[i], N = from.N[i], l = to.L[i], m = to.M[i], o = to.N[i];
    T dx = d.x[i], dy = d.y[i], dL = d.L[i], dM = d.M[i], dN = d.N[i];
    T steep = magnitude(N), dsteep = signed_as(dN, N);
    T eL = n1 * L - power_x * x * steep, eM = n1 * M - power_y * y * steep, eN = n2 * N;
    T over = T(1) / root(eL * eL + eM * eM + eN * eN);
    T kL = dn1 * L + n1 * dL - (dpower_x * x + power_x * dx) * steep - power_x * x * dsteep;
    T kM = dn1 * M + n1 * dM - (dpower_y * y + power_y * dy) * steep - power_y * y * dsteep;
    T kN = dn2 * N + n2 * dN, both = l * kL + m * kM + o * kN;
    T dl = (kL - both * l) * over, dm = (kM - both * m) * over, dn = (kN - both * o) * over;
    if (path) {
      Longer<T> before(x, y, L, M, N, lens.vergence, T(-1)), behind(x, y, l, m, o, lens.onward, T(1));
      T longer = dn1 * before.length + dn2 * behind.length;
      longer += n1 * push_longer(before, x, y, N, lens.vergence, T(-1), L, M, dx, dy, dL, dM, dN, dv);
      longer += n2 * push_longer(behind, x, y, o, lens.onward, T(1), l, m, dx, dy, dl, dm, dn, donward);
      longer += dcylinder * (x * x - y * y) + T(2) * lens.cylinder * (x * dx - y * dy);
      d.path[i] += longer;
    }
    d.L[i] = dl, d.M[i] = dm, d.N[i] = dn;
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
