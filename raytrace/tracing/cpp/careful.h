// One ray at one surface in the arithmetic of raytrace/system/surface.py and search.py, with every case they know; in float64
// also for float32 rays, for what becomes of a ray must not be decided by rounding.
#pragma once
#include <vector>

#include "phases.h"
#include "search.h"

namespace raytrace {

inline const Surface<double>& in_double(const Surface<double>& s, std::vector<double>&) { return s; }
inline Surface<double> in_double(const Surface<float>& s, std::vector<double>& sag_terms) {
  Surface<double> d{};
  d.at = s.at, d.gap = s.gap, d.c = s.c, d.k = s.k, d.n1 = s.n1, d.n2 = s.n2, d.rim = s.rim;
  for (int j = 0; j < kTerms; j++) d.a[j] = s.a[j];
  if (has_sag_terms(s.at->kind)) sag_terms.assign(s.sag_terms, s.sag_terms + kFrame + s.at->sag_term_count);
  d.sag_terms = sag_terms.data();
  return d;
}

// A ray before a surface in the frame of the one before it; then behind it.
struct Ray { double x, y, z, L, M, N, path; };

// Path from the foot of the perpendicular; whether there is a crossing.
inline bool crossing(const Surface<double>& s, double x, double y, double z, double L, double M, double N, double& t) {
  if (is_searched(s.at->kind)) return Search{s, x, y, z, L, M, N}(t);
  double c = s.c, shape = 1 + s.k;
  double A = c * (L * L + M * M + shape * N * N);
  double G = s.at->kind == kSphere ? N : N - c * (x * L + y * M + shape * z * N);
  double F = c * (x * x + y * y + shape * z * z) - 2 * z;
  double discriminant = G * G - A * F, r = signed_as(std::sqrt(std::fmax(discriminant, 0.0)), N);
  bool same_sign = (N < 0 ? -G : G) >= 0;
  t = same_sign ? F / (G + r) : (G - r) / A;
  double height = shape * c * (z + t * N);
  bool met = discriminant > 0 && height < 1 && std::fabs(t) < std::numeric_limits<double>::infinity();
  return met && (s.at->kind != kSphere || height > -1);
}

// Carries a ray over a gap and through a surface, in float64 for rays of either type; false if it is lost there.
// farthest: a path whose square is the largest number of the type; phase: the numbers of the phase.
template <typename C>
bool carry(Ray& ray, const Surface<double>& s, const C* phase, double farthest, bool with_path) {
  const double x = ray.x, y = ray.y, z = ray.z, L = ray.L, M = ray.M, N = ray.N, ahead = z - s.gap, shape = 1 + s.k;
  double hx, hy, hz, nx = 0, ny = 0, nz = 1, w = 1, cosine = N;
  if (s.at->kind == kPlane) {
    double t = ahead / N;
    if (!(std::fabs(t) < farthest)) return false;
    hx = x - t * L, hy = y - t * M, hz = 0;
  } else {
    double slide = -(x * L + y * M + ahead * N), t = 0, F, dF;
    double px = x + slide * L, py = y + slide * M, pz = ahead + slide * N;
    if (!crossing(s, px, py, pz, L, M, N, t)) return false;
    hx = px + t * L, hy = py + t * M, hz = pz + t * N;
    if (is_searched(s.at->kind)) {
      Height at = height_at(s, hx, hy);
      F = hz - at.z, dF = N - (at.x * L + at.y * M);
    } else {
      F = 0.5 * s.c * (hx * hx + hy * hy + shape * hz * hz) - hz;
      dF = s.c * (hx * L + hy * M + shape * hz * N) - N;
    }
    double step = F / dF;  // polished
    hx -= step * L, hy -= step * M, hz -= step * N;
    if (is_searched(s.at->kind)) {
      Height at = height_at(s, hx, hy);
      nx = -at.x, ny = -at.y, w = 1 + nx * nx + ny * ny;
    } else {
      nx = -s.c * hx, ny = -s.c * hy, nz = 1 - shape * s.c * hz, w = 1 - s.k * s.c * s.c * (hx * hx + hy * hy);
    }
    cosine = nx * L + ny * M + nz * N;
  }
  double l = L, m = M, o = N, added = 0;
  if (s.at->phase != kNoPhase) {
    const double normal[] = {nx, ny, nz};
    if (!through_phase(s, phase, hx, hy, l, m, o, normal, w, added)) return false;
  } else if (s.at->bend == kRefract) {
    // An index of 0 is none: the discriminant, with n2 = 0, says so.
    double D = (s.n2 - s.n1) * (s.n2 + s.n1), a = s.n1 * cosine, b_squared = D * w + a * a, n2 = s.n2 > 0 ? s.n2 : 1;
    if (!(b_squared > 0)) return false;
    double along = D / n2 / (a + signed_as(std::sqrt(b_squared), a)), mu = s.n1 / n2;
    l = mu * L + along * nx, m = mu * M + along * ny, o = mu * N + along * nz;
  } else if (s.at->bend == kReflect) {
    double twice = 2 * cosine / w;
    l = L - twice * nx, m = M - twice * ny, o = N - twice * nz;
  }
  const bool is_unit = s.at->phase == kSlopes || (s.at->phase == kNoPhase && s.at->bend == kNone);
  double factor = is_unit ? 1 : 1.5 - 0.5 * (l * l + m * m + o * o);
  if (with_path) {
    ray.path += s.n1 * reduced_path(hx, hy, hz, x, y, z, L, M, N, s.gap, s.at->gap >= 0, double(s.at->side));
    ray.path += added;
  }
  ray.x = hx, ray.y = hy, ray.z = hz, ray.L = l * factor, ray.M = m * factor, ray.N = o * factor;
  return true;
}

// Ray i of a block. A ray that is lost becomes the axial ray.
template <typename T, bool path>
void cross_carefully(const Rays<T>& from, Rays<T>& to, Notes<T>& notes, int i, const Surface<T>& s) {
  Ray ray{from.x[i], from.y[i], from.z[i], from.L[i], from.M[i], from.N[i], path ? from.path[i] : T(0)};
  std::vector<double> sag_terms;
  if (!carry(ray, in_double(s, sag_terms), s.phase, std::sqrt(double(std::numeric_limits<T>::max())), path)) {
    ray = {0, 0, 0, 0, 0, 1, 0};
    notes.valid[i] = 0, notes.lost[i] = notes.surface, notes.any_lost = true;
  }
  if (path) to.path[i] = T(ray.path);
  to.x[i] = T(ray.x), to.y[i] = T(ray.y), to.z[i] = T(ray.z);
  to.L[i] = T(ray.L), to.M[i] = T(ray.M), to.N[i] = T(ray.N);
}

}  // namespace raytrace
