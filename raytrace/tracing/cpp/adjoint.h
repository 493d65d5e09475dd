// The adjoint of one surface: from the derivatives of a merit by the rays behind it to those by the rays before it.
//
// A hit P = p + t d lies on F(P; θ) = 0 with ∇F = n. Differentiating F = 0 along the ray gives dt, and with it
//
//     s = P̄·d/(n·d),   p̄ = P̄ - s n,   d̄ += t p̄,   θ̄ += -s ∂F/∂θ          (implicit function theorem)
//
// so the root needs no differentiation. Refraction d' = μ d + g n with μ = n1/n2, g = q/n2, q = D/(a + b), a = n1 n·d,
// b = ±√(a² + D w), w = |n|², D = n2² - n1² has
//
//     ∂q/∂a = -q/b,   ∂q/∂w = -q²/2b,   ∂q/∂D = 1/2b,   and b = n2 n·d'  (no square root)
//
// The factor that renormalises d' is 1 identically and not differentiated, as in trace.py. A bar is the derivative of
// the merit by what it stands on; in the code it is a leading g.
#pragma once
#include "block.h"
#include "loops.h"

namespace raytrace {

// Derivatives of the merit by a block of rays.
template <typename T>
using Cotangents = Rays<T>;

// Sums of a block over its rays, of derivatives by the numbers of a surface.
template <typename T>
struct Sums {
  T gap = 0, c = 0, k = 0, n1 = 0, n2 = 0, a[kTerms] = {};
};

// What variable i gets from the cotangents of the normal, and from s.
template <int i, typename T, typename Face>
[[gnu::always_inline]] inline T pulled(const Face& F, T gnx, T gny, T gnz) {
  return as<T>(BY(F, kX, i) * gnx + BY(F, kY, i) * gny + BY(F, kZ, i) * gnz);
}
template <int i, typename T, typename Face>
[[gnu::always_inline]] inline T pulled(const Face& F, T gnx, T gny, T gnz, T s_bar) {
  return pulled<i, T>(F, gnx, gny, gnz) - as<T>(BY(F, i) * s_bar);
}

template <typename T, int kind, int bend, bool path, int terms>
Sums<T> pull(const Rays<T>& from, const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n, const Surface<T>& s) {
  const T gap = s.gap, n1 = s.n1, n2 = s.n2;
  const T mu = n1 / n2, D = (n2 - n1) * (n2 + n1), over_n2 = T(1) / n2, side = T(s.at->side);
  const bool has_gap = s.at->gap >= 0;
  if constexpr (has_sag_terms(kind)) sag_terms_on<true>(to, notes, n, s);
  T sum_gap = 0, sum_c = 0, sum_k = 0, sum_n1 = 0, sum_n2 = 0, sum_0 = 0, sum_1 = 0, sum_2 = 0, sum_3 = 0;
#pragma omp simd reduction(+ : sum_gap, sum_c, sum_k, sum_n1, sum_n2, sum_0, sum_1, sum_2, sum_3)
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T hx = to.x[i], hy = to.y[i], hz = to.z[i];
    T gX = g.x[i], gY = g.y[i], gZ = g.z[i], gl = g.L[i], gm = g.M[i], gn = g.N[i];

    // The normal, its squared length and the cosine.
    const auto F = face_at<kind, terms, kVaried, kAllRows>(s, notes.added, i, hx, hy, hz);
    T nx = as<T>(BY(F, kX)), ny = as<T>(BY(F, kY)), nz = as<T>(BY(F, kZ)), w = 1;
    if (!is_unit(kind)) w = nx * nx + ny * ny + nz * nz;
    T tilt = nx * L + ny * M, cosine = tilt + nz * N, over_cosine;

    // Behind the surface: Snell's law or that of reflection.
    T gL = gl, gM = gm, gN = gn, gnx = 0, gny = 0, gnz = 0, gw = 0;
    T along_n = gl * nx + gm * ny + gn * nz;
    if (bend == kRefract) {
      T a = n1 * cosine, b = n2 * (nx * to.L[i] + ny * to.M[i] + nz * to.N[i]), both = a + b;
      T divided = T(1) / (both * b * cosine);  // one division for three
      T q = D * b * cosine * divided, gq = along_n * over_n2, over_b = both * cosine * divided;
      over_cosine = both * b * divided;
      T ga = -gq * q * over_b, gD = T(0.5) * gq * over_b, gmu = gl * L + gm * M + gn * N, bent = q * over_n2;
      gw = -gD * q * q;
      T turn = ga * n1;
      gnx = bent * gl + turn * L, gny = bent * gm + turn * M, gnz = bent * gn + turn * N;
      gL = mu * gl + turn * nx, gM = mu * gm + turn * ny, gN = mu * gn + turn * nz;
      sum_n1 += ga * cosine - T(2) * n1 * gD + gmu * over_n2;
      sum_n2 += T(2) * n2 * gD - gq * bent - gmu * mu * over_n2;
    } else if (bend == kReflect) {
      T twice = T(2) / w, back = twice * along_n, tau = twice * cosine;
      gnx = -tau * gl - back * L, gny = -tau * gm - back * M, gnz = -tau * gn - back * N;
      gL = gl - back * nx, gM = gm - back * ny, gN = gn - back * nz;
      gw = along_n * tau / w;
    } else if (bend == kPhase) {  // see phase_slopes.h
      gnx = notes.turn.x[i], gny = notes.turn.y[i], gnz = notes.turn.z[i], gw = notes.turn.w[i];
    }
    if (bend != kRefract) over_cosine = T(1) / cosine;

    // Path: n1 ((P - p)·d + T lag).
    T ox = 0, oy = 0, oz = 0, ggap = 0;
    if (path) {
      T R = n1 * g.path[i];
      T forward = side * N > 0 ? T(1) + side * N : T(1), tilt = L * L + M * M;
      bool usual = side * N > 0;
      T lag = usual ? -side * tilt / forward : N - side;
      T length = (hx - x) * L + (hy - y) * M + (hz - z) * N;
      sum_n1 += g.path[i] * (length + (has_gap ? gap * lag : T(0)));
      gX += R * L, gY += R * M, gZ += R * N;
      ox = R * L, oy = R * M, oz = R * N;
      gL += R * (hx - x), gM += R * (hy - y), gN += R * (hz - z);
      if (has_gap) {
        T glag = R * gap;
        ggap = R * lag;
        gL += usual ? T(-2) * side * L / forward * glag : T(0);
        gM += usual ? T(-2) * side * M / forward * glag : T(0);
        gN += usual ? tilt / (forward * forward) * glag : glag;
      }
    }

    // The normal depends on the hit and on the shape.
    if (!is_unit(kind)) gnx += T(2) * gw * nx, gny += T(2) * gw * ny, gnz += T(2) * gw * nz;
    gX += pulled<kX, T>(F, gnx, gny, gnz), gY += pulled<kY, T>(F, gnx, gny, gnz), gZ += pulled<kZ, T>(F, gnx, gny, gnz);

    // The hit: implicit function theorem.
    // Z̄ - s n_z is written out, so that a gap gets exactly 0 from rays along the axis: they do not see it.
    T across = gX * L + gY * M, s_bar = (across + gZ * N) * over_cosine;
    gZ = (gZ * tilt - across * nz) * over_cosine;
    gX -= s_bar * nx, gY -= s_bar * ny;
    sum_c += pulled<kC, T>(F, gnx, gny, gnz, s_bar), sum_k += pulled<kK, T>(F, gnx, gny, gnz, s_bar);
    sum_0 += pulled<kA, T>(F, gnx, gny, gnz, s_bar), sum_1 += pulled<kA + 1, T>(F, gnx, gny, gnz, s_bar);
    sum_2 += pulled<kA + 2, T>(F, gnx, gny, gnz, s_bar), sum_3 += pulled<kA + 3, T>(F, gnx, gny, gnz, s_bar);
    if (is_searched(kind)) {
      notes.px[i] = pulled<kHeight, T>(F, gnx, gny, gnz, s_bar), notes.py[i] = pulled<kSlope, T>(F, gnx, gny, gnz);
    }
    if constexpr (has_sag_terms(kind)) notes.px[i] = s_bar, notes.t[i] = -gnx, notes.active[i] = -gny;
    T t = (hx - x) * L + (hy - y) * M + (hz - (z - gap)) * N;
    g.L[i] = gL + t * gX, g.M[i] = gM + t * gY, g.N[i] = gN + t * gZ;
    sum_gap += ggap - gZ;
    g.x[i] = gX - ox, g.y[i] = gY - oy, g.z[i] = gZ - oz;
  }
  Sums<T> sums;
  sums.gap = sum_gap, sums.c = sum_c, sums.k = sum_k, sums.n1 = sum_n1, sums.n2 = sum_n2;
  if constexpr (is_searched(kind)) {
    const T heads[] = {sum_0, sum_1, sum_2, sum_3};
    for (int j = 0; j < SagOf<kind>::heads; j++) sums.a[j] = heads[j];
    if (s.at->terms > SagOf<kind>::heads) sum_terms<kind>(to, notes, n, s.at->terms, sums.a);
  }
  return sums;
}

}  // namespace raytrace
