// The facets of a Fresnel lens: rays meet the plane of the vertex, and are refracted as at the asphere above it.
//
//     n = (-2 S' x, -2 S' y, 1),   |n|² = 1 + 4 S'² u,   u = x² + y²
//
// The numbers of this phase are the curvature, the conic constant and the terms of the asphere.
#pragma once
#include "adjoint.h"
#include "tangent.h"

namespace raytrace {

constexpr int kShape = 2;  // numbers before the terms

// The asphere above the plane, or how it changes, by the numbers of the phase.
template <template <typename> class Of, typename T, typename C>
Of<T> facets_of(const Surface<T>& s, const C* numbers) {
  Of<T> to{};
  to.c = T(numbers[0]), to.k = T(numbers[1]);
  for (int j = 0; j < s.at->phase_terms - kShape; j++) to.a[j] = T(numbers[kShape + j]);
  return to;
}

// Its sag as a function of u. There is a facet within the edge of a closed conic.
template <How how, Mask rows, typename T>
[[gnu::always_inline]] inline auto facet_at(const Surface<T>& facets, T u, const Change<T>* change = nullptr) {
  return Even::sag(Numbers<T, rows, how, kTerms>{facets, change}, variable<rows, kX>(u));
}

template <typename T>
void facet_normals(const Rays<T>& at, Normals<T>& to, int n, const Surface<T>& s) {
  const Surface<T> facets = facets_of<Surface>(s, s.phase);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const T x = at.x[i], y = at.y[i], u = x * x + y * y;
    const auto S = facet_at<kStill, kNoRows>(facets, u);
    const T dS = S.inside ? S.d[kX] : std::numeric_limits<T>::quiet_NaN();  // passes nothing: see `diffract`
    to.x[i] = T(-2) * dS * x, to.y[i] = T(-2) * dS * y, to.z[i] = 1, to.w[i] = T(1) + T(4) * dS * dS * u;
  }
}

// From the cotangents of the normals in notes.turn to those of where rays are, and of the numbers.
template <typename T>
void pull_facets(const Rays<T>& to, Cotangents<T>& g, Notes<T>& notes, int n, const Surface<T>& s, double* own) {
  const Surface<T> facets = facets_of<Surface>(s, s.phase);
  T sum_c = 0, sum_k = 0, sums[kTerms] = {};
#pragma omp simd reduction(+ : sum_c, sum_k)
  for (int i = 0; i < n; i++) {
    const T x = to.x[i], y = to.y[i], u = x * x + y * y;
    const T nx = notes.turn.x[i], ny = notes.turn.y[i], w = notes.turn.w[i];
    const auto S = facet_at<kVaried, 1>(facets, u);
    const T dS = S.d[kX], slope = T(-2) * (x * nx + y * ny) + T(8) * dS * u * w;
    const T by_u = slope * BY(S, kX, kX) + T(4) * dS * dS * w;
    g.x[i] += T(2) * (x * by_u - dS * nx), g.y[i] += T(2) * (y * by_u - dS * ny);
    sum_c += slope * BY(S, kX, kC), sum_k += slope * BY(S, kX, kK);
    notes.px[i] = 0, notes.py[i] = slope;
  }
  sum_terms<kEven>(to, notes, n, s.at->phase_terms - kShape, sums);
  own[0] += sum_c, own[1] += sum_k;
  for (int j = 0; j < s.at->phase_terms - kShape; j++) own[kShape + j] += sums[j];
}

// How the normals change with where rays are and with the numbers, into notes.turn.
template <typename T>
void push_facets(const Rays<T>& to, const Rays<T>& d, Notes<T>& notes, int n, const Surface<T>& s, const T* numbers) {
  const Surface<T> facets = facets_of<Surface>(s, s.phase);
  const Change<T> change = facets_of<Change>(s, numbers);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const T x = to.x[i], y = to.y[i], dx = d.x[i], dy = d.y[i], u = x * x + y * y;
    const auto S = facet_at<kMoved, 1>(facets, u, &change);
    const T dS = S.d[kX], du = T(2) * (x * dx + y * dy), slope = BY(S, kX, kX) * du + BY(S, kX, kC);
    notes.turn.x[i] = T(-2) * (slope * x + dS * dx), notes.turn.y[i] = T(-2) * (slope * y + dS * dy);
    notes.turn.z[i] = 0, notes.turn.w[i] = T(8) * dS * u * slope + T(4) * dS * dS * du;
  }
}

}  // namespace raytrace
