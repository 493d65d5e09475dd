// One ray at one surface in the arithmetic of raytrace/system/surface.py and search.py, with every case they know; in float64
// also for float32 rays, for what becomes of a ray must not be decided by rounding.
#pragma once
#include "loops.h"
#include "phases.h"

namespace raytrace {

// First crossing with an asphere, search.py line by line: Newton's method from the base conic, accepted by a
// residual relative to the size of the terms, and a bracketed search for the rays that fail.
struct AsphereSearch {
  const Surface<double>& s;
  double x, y, z, L, M, N;

  struct Residual { double F, dF, scale, u; bool inside; };
  struct Found { double t; bool small, forward; double radius; };

  Residual residual(double t) const {
    double hx = x + t * L, hy = y + t * M, hz = z + t * N, u = hx * hx + hy * hy;
    auto [S, dS, size, inside] = slope_at(s, u);
    double radial = hx * L + hy * M;
    double scale = std::fabs(hz) + std::fabs(s.c * u) + size + std::fabs(z) + std::fabs(t * N);
    scale += 2 * std::fabs(dS) * (u + std::fabs(radial) * std::fabs(t));
    return {hz - S, N - 2 * dS * radial, scale, u, inside};
  }

  Found newton(double t) const {
    const double rounding = std::numeric_limits<double>::epsilon();
    for (int step = 0; step < 24; step++) {
      Residual r = residual(t);
      if (r.dF == 0 || !std::isfinite(r.F)) break;
      t -= r.F / r.dF;
      if (!(std::fabs(r.F) > rounding * r.scale)) break;
    }
    Residual r = residual(t);
    bool small = std::fabs(r.F) <= 64 * rounding * r.scale && r.inside && std::isfinite(t);
    return {t, small, r.dF * (N < 0 ? -1 : 1) > 0, std::sqrt(r.u)};
  }

  double start() const {
    double plane = std::fabs(N) > 1e-6 ? -z / N : 0, shape = 1 + s.k;
    double A = s.c * (L * L + M * M + shape * N * N);
    double G = N - s.c * (x * L + y * M + shape * z * N);
    double F = s.c * (x * x + y * y + shape * z * z) - 2 * z;
    double discriminant = G * G - A * F;
    if (!(discriminant > 0) || !(G * N > 0)) return plane;
    double t = F / (G + signed_as(std::sqrt(discriminant), N));
    return std::hypot(x + t * L, y + t * M) <= s.rim ? t : plane;
  }

  bool bracketed(double& found_at) const {
    const int samples = 96, bisections = 64;
    const double infinity = std::numeric_limits<double>::infinity();
    const double big = std::pow(std::numeric_limits<double>::max(), 0.48);  // its square is a number
    double closed = (1 + s.k) * s.c * s.c, edge = closed > 0 ? 1 / std::sqrt(closed) : big;
    double reach = 4 * (std::sqrt(x * x + y * y) + std::fabs(z));
    double radius = edge < big ? std::fmin(edge, s.rim) : s.rim;
    if (!(radius < big)) radius = reach;

    double A = L * L + M * M, B = x * L + y * M, C = x * x + y * y - radius * radius;
    double discriminant = B * B - A * C, width_root = std::sqrt(std::fmax(discriminant, 0.0));
    double first = A > 0 ? (-B - width_root) / A : -big, last = A > 0 ? (-B + width_root) / A : big;
    bool possible = A > 0 ? discriminant >= 0 : C <= 0;

    double low = infinity, high = -infinity;
    for (int i = 0; i <= 64; i++) {
      double at = i / 64.0 * radius, S = slope_at(s, at * at * (1 - 1e-7)).S;
      low = std::fmin(low, S), high = std::fmax(high, S);
    }
    double margin = (high - low) * 0.05 + std::numeric_limits<double>::min();
    low -= margin, high += margin;
    if (std::fabs(N) > 1e-9) {
      double at_low = (low - z) / N, at_high = (high - z) / N;
      first = std::fmax(first, std::fmin(at_low, at_high));
      last = std::fmin(last, std::fmax(at_low, at_high));
    }
    if (!possible || !(last >= first)) return false;

    double sign = N < 0 ? -1 : 1, width = (last - first) / samples, before = sign * residual(first).F;
    bool found = false;
    double left = first;
    for (int i = 1; i <= samples && !found; i++) {
      double t = first + i * width, after = sign * residual(t).F;
      if (before <= 0 && after > 0) left = t - width, found = true;
      before = after;
    }
    if (!found) return false;
    double right = left + width;
    for (int i = 0; i < bisections; i++) {
      double middle = 0.5 * (left + right);
      (sign * residual(middle).F <= 0 ? left : right) = middle;
    }
    double t = 0.5 * (left + right);
    Found polished = newton(t);
    bool stayed = polished.small && polished.forward && std::fabs(polished.t - t) <= std::fabs(width);
    found_at = stayed ? polished.t : t;
    return true;
  }

  bool operator()(double& t) const {
    Found found = newton(start());
    bool converged = found.small && found.forward;
    t = found.t;
    if (converged && found.radius <= s.rim) return true;
    return bracketed(t) || converged;
  }
};

inline const Surface<double>& in_double(const Surface<double>& s) { return s; }
inline Surface<double> in_double(const Surface<float>& s) {
  Surface<double> d{};
  d.at = s.at, d.gap = s.gap, d.c = s.c, d.k = s.k, d.n1 = s.n1, d.n2 = s.n2, d.rim = s.rim;
  for (int j = 0; j < kTerms; j++) d.a[j] = s.a[j];
  return d;
}

// A ray before a surface in the frame of the one before it; then behind it.
struct Ray { double x, y, z, L, M, N, path; };

// Path from the foot of the perpendicular; whether there is a crossing.
inline bool crossing(const Surface<double>& s, double x, double y, double z, double L, double M, double N, double& t) {
  if (has_terms(s.at->kind)) return AsphereSearch{s, x, y, z, L, M, N}(t);
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
    const bool asphere = has_terms(s.at->kind);
    double slide = -(x * L + y * M + ahead * N), t = 0, F, dF;
    double px = x + slide * L, py = y + slide * M, pz = ahead + slide * N;
    if (!crossing(s, px, py, pz, L, M, N, t)) return false;
    hx = px + t * L, hy = py + t * M, hz = pz + t * N;
    if (asphere) {
      Slope at = slope_at(s, hx * hx + hy * hy);
      F = hz - at.S, dF = N - 2 * at.dS * (hx * L + hy * M);
    } else {
      F = 0.5 * s.c * (hx * hx + hy * hy + shape * hz * hz) - hz;
      dF = s.c * (hx * L + hy * M + shape * hz * N) - N;
    }
    double step = F / dF;  // polished
    hx -= step * L, hy -= step * M, hz -= step * N;
    if (asphere) {
      double dS = slope_at(s, hx * hx + hy * hy).dS;
      nx = -2 * dS * hx, ny = -2 * dS * hy, w = 1 + 4 * dS * dS * (hx * hx + hy * hy);
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
  if (!carry(ray, in_double(s), s.phase, std::sqrt(double(std::numeric_limits<T>::max())), path)) {
    ray = {0, 0, 0, 0, 0, 1, 0};
    notes.valid[i] = 0, notes.lost[i] = notes.surface, notes.any_lost = true;
  }
  if (path) to.path[i] = T(ray.path);
  to.x[i] = T(ray.x), to.y[i] = T(ray.y), to.z[i] = T(ray.z);
  to.L[i] = T(ray.L), to.M[i] = T(ray.M), to.N[i] = T(ray.N);
}

}  // namespace raytrace
