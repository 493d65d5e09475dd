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

// S' at u, and what moves it.
template <typename T>
struct Facet {
  T dS, by_u, by_c, by_k;  // S', ∂S'/∂u, ∂S'/∂c, ∂S'/∂k
  bool within;             // of the edge of a closed conic, beyond which there is no facet

  template <typename C>
  Facet(const C* numbers, int terms, T u) {
    const T c = T(numbers[0]), shape = T(1) + T(numbers[1]), radicand = T(1) - shape * c * c * u;
    within = radicand > 0;
    const T over_w = T(1) / root(radicand > 0 ? radicand : std::numeric_limits<T>::min()), steep = c * over_w;
    T p = 0, dp = 0, d2p = 0;  // d2p carries p''/2
    for (int j = terms - 1; j >= 0; j--) {
      d2p = d2p * u + dp, dp = dp * u + p, p = p * u + T(numbers[kShape + j]);
    }
    const T third = over_w * over_w * over_w;
    dS = T(0.5) * steep + p + u * dp;
    by_u = T(0.25) * shape * steep * steep * steep + T(2) * (dp + u * d2p);
    by_c = T(0.5) * third, by_k = T(0.25) * c * (c * c * u) * third;
  }
};

template <typename T>
void facet_normals(const Rays<T>& at, Normals<T>& to, int n, const Surface<T>& s) {
  for (int i = 0; i < n; i++) {
    const T x = at.x[i], y = at.y[i], u = x * x + y * y;
    const Facet<T> facet(s.phase, s.at->phase_terms - kShape, u);
    const T dS = facet.within ? facet.dS : std::numeric_limits<T>::quiet_NaN();  // passes nothing: see `diffract`
    to.x[i] = T(-2) * dS * x, to.y[i] = T(-2) * dS * y, to.z[i] = 1, to.w[i] = T(1) + T(4) * dS * dS * u;
  }
}

// From the cotangents of the normals in notes.turn to those of where rays are, and of the numbers.
template <typename T>
void pull_facets(const Rays<T>& to, Cotangents<T>& g, const Notes<T>& notes, int n, const Surface<T>& s, double* own) {
  const int terms = s.at->phase_terms - kShape;
  for (int i = 0; i < n; i++) {
    const T x = to.x[i], y = to.y[i], u = x * x + y * y;
    const T nx = notes.turn.x[i], ny = notes.turn.y[i], w = notes.turn.w[i];
    const Facet<T> at(s.phase, terms, u);
    T slope = T(-2) * (x * nx + y * ny) + T(8) * at.dS * u * w;
    const T by_u = slope * at.by_u + T(4) * at.dS * at.dS * w;
    g.x[i] += T(2) * (x * by_u - at.dS * nx), g.y[i] += T(2) * (y * by_u - at.dS * ny);
    own[0] += slope * at.by_c, own[1] += slope * at.by_k;
    for (int j = 0; j < terms; j++, slope *= u) own[kShape + j] += T(j + 1) * slope;
  }
}

// How the normals change with where rays are and with the numbers, into notes.turn.
template <typename T>
void push_facets(const Rays<T>& to, const Rays<T>& d, Notes<T>& notes, int n, const Surface<T>& s, const T* change) {
  const int terms = s.at->phase_terms - kShape;
  for (int i = 0; i < n; i++) {
    const T x = to.x[i], y = to.y[i], dx = d.x[i], dy = d.y[i], u = x * x + y * y;
    const Facet<T> at(s.phase, terms, u);
    T du = T(2) * (x * dx + y * dy), slope = at.by_u * du + at.by_c * change[0] + at.by_k * change[1], power = 1;
    for (int j = 0; j < terms; j++, power *= u) slope += T(j + 1) * change[kShape + j] * power;
    notes.turn.x[i] = T(-2) * (slope * x + at.dS * dx), notes.turn.y[i] = T(-2) * (slope * y + at.dS * dy);
    notes.turn.z[i] = 0, notes.turn.w[i] = T(8) * at.dS * u * slope + T(4) * at.dS * at.dS * du;
  }
}

}  // namespace raytrace
