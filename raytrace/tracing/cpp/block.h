// The values that one call traces through: surfaces with their numbers, and a block of rays that stays in the cache.
//
// Every loop over a block runs over whole vectors (a block is filled up with axial rays), so a ray's result does not
// depend on its neighbours; `careful.h` takes the flagged rays one by one, as raytrace/system/surface.py would.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

namespace raytrace {

constexpr int kBlock = 256;   // rays
constexpr int kVector = 16;   // rays: whole vectors of either type
constexpr int kTerms = 16;    // of an asphere, at most
constexpr int kFields = 18;   // integers that tell of a surface, see structure.py

enum Bend { kNone, kRefract, kReflect, kPhase };

// One surface as structure.py lays it out. Offsets count numbers of a row; -1 stands for a number that is not modelled.
struct Layout {
  int32_t kind, bend, side, terms, apertures, first_aperture;
  int32_t gap, curvature, conic, coefficients, before, behind;
  int32_t rim;  // place in the constants
  int32_t phase, phase_terms, phase_numbers;  // form of phases.h, 0 for none; how many numbers, and the first of them
  int32_t sag_term_count, sag_term_numbers;  // powers of sag_terms.h, and the first of its numbers
};
static_assert(sizeof(Layout) == kFields * sizeof(int32_t), "structure.py writes 18 integers");

// The same surface with the numbers of one row.
template <typename T>
struct Surface {
  const Layout* at;
  T gap, c, k, n1, n2;  // 0 where not modelled; n1, n2 before and behind
  T a[kTerms];
  const T* phase;  // numbers of the phase
  const T* sag_terms;  // and of the sag terms
  double rim;
  T span, over_span;  // the square of a length of the surface, a power of 2, in which its derivatives stay in range
};

// By the curvature 1/length and coefficients of u^(j+1), length^-(2j+1).
template <typename T>
void set_span(Surface<T>& s) {
  constexpr int most = std::numeric_limits<T>::max_exponent / 2 - 2;
  int length = s.c != 0 ? -std::ilogb(s.c) : most;
  for (int j = 0; j < s.at->terms; j++) {
    if (s.a[j] != 0) length = std::min(length, -std::ilogb(s.a[j]) / (2 * j + 1));
  }
  length = std::max(-most, std::min(most, length));
  s.span = std::ldexp(T(1), 2 * length), s.over_span = std::ldexp(T(1), -2 * length);
}

template <typename T>
Surface<T> surface_of(const Layout& at, const T* row, const double* constants) {
  auto number = [row](int32_t offset) { return offset < 0 ? T(0) : row[offset]; };
  Surface<T> s{};
  s.at = &at;
  s.gap = number(at.gap);
  s.c = number(at.curvature);
  s.k = number(at.conic);
  s.n1 = number(at.before);
  s.n2 = number(at.behind);
  for (int j = 0; j < at.terms; j++) s.a[j] = row[at.coefficients + j];
  s.phase = row + at.phase_numbers;
  s.sag_terms = row + at.sag_term_numbers;
  s.rim = constants[at.rim];
  set_span(s);
  return s;
}

// Changes of the numbers of a surface, and whether there are any.
template <typename T>
struct Change {
  T gap, c, k, n1, n2, a[kTerms];
  const T *phase, *sag_terms;
  bool any;
};

// Rays in the frame of one surface; path is touched only where it is asked for.
template <typename T>
struct alignas(64) Rays {
  T x[kBlock], y[kBlock], z[kBlock], L[kBlock], M[kBlock], N[kBlock], path[kBlock];
};

// A vector at every ray of a block, and a number: normals and their squared lengths, and what moves them.
template <typename T>
struct alignas(64) Normals {
  T x[kBlock], y[kBlock], z[kBlock], w[kBlock];
};

// A path or a sag p(x, y) at `size` points, its slopes and second derivatives; q: a polynomial on the way there; u, v: the
// points as sag terms counts them.
template <typename T, int size>
struct alignas(64) Added {
  T p[size], x[size], y[size], xx[size], xy[size], yy[size], q[size], dq[size], d2q[size];
  T u[size], v[size];
};

// What the loops note of a block beside its rays. valid: neither lost nor vignetted; lost: number of the last surface
// that a ray missed or was totally reflected at, or -1.
template <typename T>
struct alignas(64) Notes {
  T flagged[kBlock];
  T px[kBlock], py[kBlock], pz[kBlock], t[kBlock], active[kBlock];  // of Newton's method: foot, path from it
  Normals<T> normal, turn;  // at a surface with a phase; turn: the cotangents of the normals, or how they change
  Added<T, kBlock> added;
  uint8_t valid[kBlock];
  int32_t lost[kBlock], surface;  // surface: the one that the rays are at
  bool any_lost;
};

template <typename T>
inline T magnitude(T v) { return v < 0 ? -v : v; }
template <typename T>
inline T signed_as(T size, T sign) { return sign < 0 ? -size : size; }
inline float root(float v) { return __builtin_sqrtf(v); }
inline double root(double v) { return __builtin_sqrt(v); }

// cos² of incidence under which a loop leaves a ray to `careful`: there float32 would lose digits of the root, which
// surface.py takes in float64.
template <typename T>
constexpr T kGrazing = sizeof(T) == 4 ? T(0.1) : T(1e-3);
// b² of Snell's law (trace.py) up to which a loop leaves a ray to `careful`: there rounding to float32 would decide
// whether light passes.
template <typename T>
constexpr T kCritical = sizeof(T) == 4 ? T(1e-4) : T(0);
// |1 - n_z| at which a hit is near the edge of the vertex sheet.
template <typename T>
constexpr T kEdge = sizeof(T) == 4 ? T(0.99) : T(0.999999);
// Paths, mm, beyond which squares overflow.
template <typename T>
constexpr T kFar = sizeof(T) == 4 ? T(1e18) : T(1e150);

}  // namespace raytrace
