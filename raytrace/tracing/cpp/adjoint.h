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

template <typename T, int kind, int bend, bool path, int terms>
Sums<T> pull(const Rays<T>& from, const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n, const Surface<T>& s) {
  const T gap = s.gap, c = s.c, k = s.k, shape = T(1) + k, n1 = s.n1, n2 = s.n2;
  const T mu = n1 / n2, D = (n2 - n1) * (n2 + n1), over_n2 = T(1) / n2, side = T(s.at->side);
  const bool has_gap = s.at->gap >= 0;
  if constexpr (has_sag_terms(kind)) sag_terms_on<true>(to, notes, n, s);
  T sum_gap = 0, sum_c = 0, sum_k = 0, sum_n1 = 0, sum_n2 = 0, sum_first = 0, sum_second = 0;
#pragma omp simd reduction(+ : sum_gap, sum_c, sum_k, sum_n1, sum_n2, sum_first, sum_second)
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T hx = to.x[i], hy = to.y[i], hz = to.z[i];
    T gX = g.x[i], gY = g.y[i], gZ = g.z[i], gl = g.L[i], gm = g.M[i], gn = g.N[i];
    T u = hx * hx + hy * hy;

    // The normal, its squared length and the cosine.
    [[maybe_unused]] std::conditional_t<is_freeform(kind), SheetOf<T, kind, terms>, int> sheet{};
    T nx = 0, ny = 0, nz = 1, w = 1, S, dS = 0, d2S = 0;
    if (kind == kSphere || kind == kConic) {
      nx = -c * hx, ny = -c * hy, nz = T(1) - shape * c * hz;
      if (kind == kConic) w = T(1) - k * c * c * u;
    } else if (has_terms(kind)) {
      sag<kind, true>(s, terms, u, S, dS, d2S);
      nx = T(-2) * dS * hx, ny = T(-2) * dS * hy, w = T(1) + T(4) * dS * dS * u;
    } else if constexpr (has_sag_terms(kind)) {
      sag<kind, true>(s, terms, u, S, dS, d2S);
      nx = T(-2) * dS * hx - notes.added.x[i], ny = T(-2) * dS * hy - notes.added.y[i], w = T(1) + nx * nx + ny * ny;
    } else if constexpr (is_freeform(kind)) {
      sheet = sheet_at<kind, terms, true>(s, hx, hy);
      nx = -sheet.x, ny = -sheet.y, w = T(1) + nx * nx + ny * ny;
    }
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
    T gdS = 0, over_w = 0, conic_sag = 0, gx = 0, gy = 0;  // gx, gy: of the slopes of a sag that is not round
    if (kind == kSphere || kind == kConic) {
      gX -= c * gnx, gY -= c * gny, gZ -= shape * c * gnz;
      sum_c -= hx * gnx + hy * gny + shape * hz * gnz;
      if (kind == kConic) {
        T pull_w = T(-2) * k * c * gw;
        gX += pull_w * c * hx, gY += pull_w * c * hy;
        sum_c += pull_w * u;
        sum_k -= c * hz * gnz + c * c * u * gw;
      }
    } else if (has_terms(kind)) {
      gdS = T(-2) * (hx * gnx + hy * gny) + T(8) * dS * u * gw;
      T radicand = T(1) - shape * c * c * u;
      over_w = T(1) / root(radicand > 0 ? radicand : T(1));
      T steep = c * over_w;
      T gu = gdS * d2S + T(0.25) * shape * steep * gdS * steep * steep + T(4) * dS * dS * gw;
      gX += T(2) * (hx * gu - dS * gnx), gY += T(2) * (hy * gu - dS * gny);
      conic_sag = c * u * over_w / (over_w + T(1));
      T third = over_w * over_w * over_w;
      sum_c += T(0.5) * gdS * third;
      sum_k += T(0.25) * gdS * c * c * c * u * third;
    } else if constexpr (has_sag_terms(kind)) {
      gx = T(-2) * nx * gw - gnx, gy = T(-2) * ny * gw - gny;
      gdS = T(2) * (hx * gx + hy * gy);
      T radicand = T(1) - shape * c * c * u;
      over_w = T(1) / root(radicand > 0 ? radicand : T(1));
      T steep = c * over_w, gu = gdS * d2S + T(0.25) * shape * steep * gdS * steep * steep;
      gX += T(2) * (hx * gu + dS * gx) + notes.added.xx[i] * gx + notes.added.xy[i] * gy;
      gY += T(2) * (hy * gu + dS * gy) + notes.added.xy[i] * gx + notes.added.yy[i] * gy;
      conic_sag = c * u * over_w / (over_w + T(1));
      T third = over_w * over_w * over_w;
      sum_c += T(0.5) * gdS * third;
      sum_k += T(0.25) * gdS * c * c * c * u * third;
    } else if constexpr (is_freeform(kind)) {
      gx = T(2) * sheet.x * gw - gnx, gy = T(2) * sheet.y * gw - gny;
      gX += sheet.xx * gx + sheet.xy * gy, gY += sheet.xy * gx + sheet.yy * gy;
    }

    // The hit: implicit function theorem.
    // Z̄ - s n_z is written out, so that a gap gets exactly 0 from rays along the axis: they do not see it.
    T across = gX * L + gY * M, s_bar = (across + gZ * N) * over_cosine;
    gZ = (gZ * tilt - across * nz) * over_cosine;
    gX -= s_bar * nx, gY -= s_bar * ny;
    if (kind == kSphere || kind == kConic) {
      sum_c += T(0.5) * s_bar * (u + shape * hz * hz);
      if (kind == kConic) sum_k += T(0.5) * s_bar * c * hz * hz;
    } else if (has_terms(kind) || has_sag_terms(kind)) {
      sum_c += s_bar * u * over_w * over_w / (over_w + T(1));
      sum_k += T(0.5) * s_bar * c * conic_sag * conic_sag * over_w;
      notes.px[i] = s_bar, notes.py[i] = gdS;
      if constexpr (has_sag_terms(kind)) notes.t[i] = gx, notes.active[i] = gy;
    } else if constexpr (is_freeform(kind)) {
      const Shares<T> shares = sheet.pulled(s_bar, gx, gy);
      sum_c += shares.c, sum_k += shares.k, sum_first += shares.first, sum_second += shares.second;
      notes.px[i] = shares.height, notes.py[i] = shares.slope;
    }
    T t = (hx - x) * L + (hy - y) * M + (hz - (z - gap)) * N;
    g.L[i] = gL + t * gX, g.M[i] = gM + t * gY, g.N[i] = gN + t * gZ;
    sum_gap += ggap - gZ;
    g.x[i] = gX - ox, g.y[i] = gY - oy, g.z[i] = gZ - oz;
  }
  Sums<T> sums;
  sums.gap = sum_gap, sums.c = sum_c, sums.k = sum_k, sums.n1 = sum_n1, sums.n2 = sum_n2;
  if constexpr (has_terms(kind) || has_sag_terms(kind)) sum_terms<kind>(to, notes, n, s.at->terms, sums.a);
  if constexpr (is_freeform(kind)) sums.a[0] = sum_first;
  if constexpr (kind == kBiconic) sums.a[1] = sum_second;
  if constexpr (kind == kToroidal && terms > 1) sum_series<1, false, true>(to, notes, n, s.at->terms - 1, sums.a + 1);
  return sums;
}

}  // namespace raytrace
