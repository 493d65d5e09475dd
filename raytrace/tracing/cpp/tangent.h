// The derivative of one surface in a direction: from the change of the rays before it and of its numbers to that of the
// rays behind. Forward mode: one push for each variable, through the surfaces behind the one that it belongs to.
//
// With the symbols of adjoint.h, a leading d for a change, and F(P; θ) = 0 on the surface:
//
//     dP = dp + t dd + d dt,   dt = -(n·(dp + t dd) + ∂F/∂θ dθ)/(n·d)
//     dd' = dμ d + μ dd + dg n + g dn,   dq = -(q/b) da - (q²/2b) dw + dD/2b
#pragma once
#include "block.h"
#include "loops.h"

namespace raytrace {

template <typename T>
Change<T> change_of(const Layout& at, const T* row) {
  auto number = [row](int32_t offset) { return offset < 0 ? T(0) : row[offset]; };
  Change<T> change{};
  change.gap = number(at.gap), change.c = number(at.curvature), change.k = number(at.conic);
  change.n1 = number(at.before), change.n2 = number(at.behind);
  for (int j = 0; j < at.terms; j++) change.a[j] = row[at.coefficients + j];
  change.any = change.gap != 0 || change.c != 0 || change.k != 0 || change.n1 != 0 || change.n2 != 0;
  for (int j = 0; j < at.terms; j++) change.any |= change.a[j] != 0;
  change.phase = row + at.phase_numbers;
  for (int j = 0; j < at.phase_terms; j++) change.any |= change.phase[j] != 0;
  change.sag_terms = row + at.sag_term_numbers;
  for (int j = 0; has_sag_terms(at.kind) && j < kFrame + at.sag_term_count; j++) change.any |= change.sag_terms[j] != 0;
  return change;
}

// How slope i of F changes where the hit does, and with the numbers.
template <int i, typename T, typename Face>
[[gnu::always_inline]] inline T pushed(const Face& F, T px, T py, T pz) {
  return as<T>(BY(F, kX, i) * px + BY(F, kY, i) * py + BY(F, kZ, i) * pz + BY(F, i, kC));
}

template <typename T, int kind, int bend, bool path, int terms>
void push(const Rays<T>& from, const Rays<T>& to, Rays<T>& d, Notes<T>& notes, int n, const Surface<T>& s,
          const Change<T>& change) {
  const T gap = s.gap, n1 = s.n1, n2 = s.n2, side = T(s.at->side), dgap = change.gap, dn1 = change.n1, dn2 = change.n2;
  const T mu = n1 / n2, D = (n2 - n1) * (n2 + n1), over_n2 = T(1) / n2;
  const T dmu = (dn1 - mu * dn2) * over_n2, dD = T(2) * (n2 * dn2 - n1 * dn1);
  const bool has_gap = s.at->gap >= 0;
  if constexpr (has_sag_terms(kind)) sag_terms_change(to, notes, n, s, change.sag_terms);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T hx = to.x[i], hy = to.y[i], hz = to.z[i];
    T dx = d.x[i], dy = d.y[i], dz = d.z[i], dL = d.L[i], dM = d.M[i], dN = d.N[i];

    // The normal, its squared length, and how the numbers of the surface change F at the hit.
    const auto F = face_at<kind, terms, kMoved, kAllRows>(s, notes.added, i, hx, hy, hz, &change);
    T nx = as<T>(BY(F, kX)), ny = as<T>(BY(F, kY)), nz = as<T>(BY(F, kZ)), w = 1, moved = as<T>(BY(F, kC));
    if (!is_unit(kind)) w = nx * nx + ny * ny + nz * nz;
    if constexpr (has_sag_terms(kind)) moved -= notes.px[i];
    T cosine = nx * L + ny * M + nz * N;

    // The hit.
    T t = (hx - x) * L + (hy - y) * M + (hz - (z - gap)) * N;
    T px = dx + t * dL, py = dy + t * dM, pz = dz - dgap + t * dN;
    T dt = -(nx * px + ny * py + nz * pz + moved) / cosine;
    px += dt * L, py += dt * M, pz += dt * N;

    // Path: n1 ((P - p)·d + T lag).
    if (path) {
      T length = (hx - x) * L + (hy - y) * M + (hz - z) * N;
      T longer = (px - dx) * L + (py - dy) * M + (pz - dz) * N + (hx - x) * dL + (hy - y) * dM + (hz - z) * dN;
      if (has_gap) {
        bool usual = side * N > 0;
        T forward = usual ? T(1) + side * N : T(1), tilt = L * L + M * M;
        T lag = usual ? -side * tilt / forward : N - side;
        T dlag = usual ? (T(-2) * side * (L * dL + M * dM) + tilt / forward * dN) / forward : dN;
        length += gap * lag, longer += dgap * lag + gap * dlag;
      }
      d.path[i] += n1 * longer + dn1 * length;
    }

    // The normal there.
    T dnx = pushed<kX>(F, px, py, pz), dny = pushed<kY>(F, px, py, pz), dnz = pushed<kZ>(F, px, py, pz), dw = 0;
    if constexpr (has_sag_terms(kind)) dnx -= notes.py[i], dny -= notes.pz[i];
    if (!is_unit(kind)) dw = T(2) * (nx * dnx + ny * dny + nz * dnz);

    // Behind the surface.
    if (bend == kPhase) {  // see phase_slopes.h
      notes.turn.x[i] = dnx, notes.turn.y[i] = dny, notes.turn.z[i] = dnz, notes.turn.w[i] = dw;
    } else if (bend != kNone) {
      T dcosine = dnx * L + dny * M + dnz * N + nx * dL + ny * dM + nz * dN;
      T keep = 1, dkeep = 0, g, dg;
      if (bend == kRefract) {
        T a = n1 * cosine, b = n2 * (nx * to.L[i] + ny * to.M[i] + nz * to.N[i]);
        T q = D / (a + b), da = dn1 * cosine + n1 * dcosine;
        T dq = (T(-1) * q * da - T(0.5) * q * q * dw + T(0.5) * dD) / b;
        keep = mu, dkeep = dmu, g = q * over_n2, dg = (dq - g * dn2) * over_n2;
      } else {
        g = T(-2) * cosine / w, dg = (T(-2) * dcosine - g * dw) / w;
      }
      dL = dkeep * L + keep * dL + dg * nx + g * dnx;
      dM = dkeep * M + keep * dM + dg * ny + g * dny;
      dN = dkeep * N + keep * dN + dg * nz + g * dnz;
    }
    d.x[i] = px, d.y[i] = py, d.z[i] = kind == kPlane ? T(0) : pz;
    d.L[i] = dL, d.M[i] = dM, d.N[i] = dN;
  }
}

}  // namespace raytrace
