// Axes that turn and shift between two surfaces: p' = R p + t, d' = R d (raytrace/system/pose.py, `Turn`).
//
// A turn is a row of its own before the surface that stands in the new axes; a coordinate break is nothing else. The path
// drops by that of the axial ray over the gap that the turn has in it.
#pragma once
#include "adjoint.h"
#include "tangent.h"

namespace raytrace {

constexpr int kTurn = -1;         // as a kind of surface
constexpr int kTurnNumbers = 13;  // its terms: R by rows, t, the path
static_assert(kTurnNumbers <= kTerms, "the numbers of a turn are stored as the terms of a surface");

template <typename T, bool path>
int turn(const Rays<T>& from, Rays<T>& to, Notes<T>&, int n, const Surface<T>& s) {
  T R[kTurnNumbers];
  for (int j = 0; j < kTurnNumbers; j++) R[j] = s.a[j];
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    to.x[i] = R[0] * x + R[1] * y + R[2] * z + R[9];
    to.y[i] = R[3] * x + R[4] * y + R[5] * z + R[10];
    to.z[i] = R[6] * x + R[7] * y + R[8] * z + R[11];
    to.L[i] = R[0] * L + R[1] * M + R[2] * N;
    to.M[i] = R[3] * L + R[4] * M + R[5] * N;
    to.N[i] = R[6] * L + R[7] * M + R[8] * N;
    if (path) to.path[i] = from.path[i] - R[12];
  }
  return 0;
}

// The adjoint: p̄ = Rᵀ p̄', d̄ = Rᵀ d̄', R̄ = p̄' pᵀ + d̄' dᵀ, t̄ = p̄'.
template <typename T, bool path>
Sums<T> pull_turn(const Rays<T>& from, const Rays<T>&, Rays<T>& g, Notes<T>&, int n, const Surface<T>& s) {
  T R[9];
  for (int j = 0; j < 9; j++) R[j] = s.a[j];
  T xx = 0, xy = 0, xz = 0, yx = 0, yy = 0, yz = 0, zx = 0, zy = 0, zz = 0, tx = 0, ty = 0, tz = 0, longer = 0;
#pragma omp simd reduction(+ : xx, xy, xz, yx, yy, yz, zx, zy, zz, tx, ty, tz, longer)
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T gx = g.x[i], gy = g.y[i], gz = g.z[i], gl = g.L[i], gm = g.M[i], gn = g.N[i];
    xx += gx * x + gl * L, xy += gx * y + gl * M, xz += gx * z + gl * N;
    yx += gy * x + gm * L, yy += gy * y + gm * M, yz += gy * z + gm * N;
    zx += gz * x + gn * L, zy += gz * y + gn * M, zz += gz * z + gn * N;
    tx += gx, ty += gy, tz += gz;
    if (path) longer -= g.path[i];
    g.x[i] = R[0] * gx + R[3] * gy + R[6] * gz;
    g.y[i] = R[1] * gx + R[4] * gy + R[7] * gz;
    g.z[i] = R[2] * gx + R[5] * gy + R[8] * gz;
    g.L[i] = R[0] * gl + R[3] * gm + R[6] * gn;
    g.M[i] = R[1] * gl + R[4] * gm + R[7] * gn;
    g.N[i] = R[2] * gl + R[5] * gm + R[8] * gn;
  }
  Sums<T> sums;
  const T all[] = {xx, xy, xz, yx, yy, yz, zx, zy, zz, tx, ty, tz, longer};
  for (int j = 0; j < kTurnNumbers; j++) sums.a[j] = all[j];
  return sums;
}

// Forward: dp' = R dp + dR p + dt, dd' = R dd + dR d.
template <typename T, bool path>
void push_turn(const Rays<T>& from, const Rays<T>&, Rays<T>& d, Notes<T>&, int n, const Surface<T>& s, const Change<T>& c) {
  T R[9], C[kTurnNumbers];
  for (int j = 0; j < 9; j++) R[j] = s.a[j];
  for (int j = 0; j < kTurnNumbers; j++) C[j] = c.a[j];
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T dx = d.x[i], dy = d.y[i], dz = d.z[i], dL = d.L[i], dM = d.M[i], dN = d.N[i];
    d.x[i] = R[0] * dx + R[1] * dy + R[2] * dz + (C[0] * x + C[1] * y + C[2] * z + C[9]);
    d.y[i] = R[3] * dx + R[4] * dy + R[5] * dz + (C[3] * x + C[4] * y + C[5] * z + C[10]);
    d.z[i] = R[6] * dx + R[7] * dy + R[8] * dz + (C[6] * x + C[7] * y + C[8] * z + C[11]);
    d.L[i] = R[0] * dL + R[1] * dM + R[2] * dN + (C[0] * L + C[1] * M + C[2] * N);
    d.M[i] = R[3] * dL + R[4] * dM + R[5] * dN + (C[3] * L + C[4] * M + C[5] * N);
    d.N[i] = R[6] * dL + R[7] * dM + R[8] * dN + (C[6] * L + C[7] * M + C[8] * N);
    if (path) d.path[i] -= C[12];
  }
}

}  // namespace raytrace
