// First crossing with a surface that is more than a conic, raytrace/system/search.py line by line: Newton's method from the
// base quadric, accepted by a residual relative to the size of the terms, and a bracketed search for the rays that fail.
#pragma once
#include <algorithm>
#include <utility>

#include "loops.h"

namespace raytrace {

// A sag at a point, with its slopes; size: what it adds up from. Beyond its edge its roots are held at 0.
struct Height { double z, x, y, size; bool inside; };

// Without sag terms.
inline Height base_at(const Surface<double>& s, double x, double y) {
  Height to{};
  by_kind_of_terms(*s.at, [&](auto kind, auto count) {
    const auto S = sag_at<kind(), count(), kStill, kNoRows>(s, x, y);
    const double size = std::fabs(S.v) + std::fabs(s.c) * (x * x + y * y) + size_of_terms<kind()>(s, x, y);
    to = {S.v, S.d[kX], S.d[kY], size, S.inside};
  });
  return to;
}

inline Height height_at(const Surface<double>& s, double x, double y) {
  Height to = base_at(s, x, y);
  if (has_sag_terms(s.at->kind)) {
    const Added<double, 1> D = sag_terms_at(s, x, y);
    to.z += D.p[0], to.x += D.x[0], to.y += D.y[0], to.size += sag_terms_size(s, std::hypot(x, y));
  }
  return to;
}

struct Residual { double F, dF, scale, u; bool inside; };
struct Found { double t; bool small, forward; double radius; };
struct Stretch { double first, last; bool possible; };

inline double big() { return std::pow(std::numeric_limits<double>::max(), 0.48); }  // its square is a number

// How far the sheet of the vertex goes along x and y, at most to a limit.
struct Extent { double x, y; };

inline double edge_of(double c, double k, double limit) {
  double closed = (1 + k) * c * c;
  return closed > 0 ? std::fmin(1 / std::sqrt(closed), limit) : limit;
}

inline Extent extent_of(const Surface<double>& s, double limit) {
  const double c_x = s.a[0], y = edge_of(s.c, s.k, limit);
  if (s.at->kind == kBiconic) {  // a section that stays open along one axis moves the edge along the other one out
    const double open_x = std::fmax(0.0, -(1 + s.a[1]) * (c_x * limit) * (c_x * limit));
    const double open_y = std::fmax(0.0, -(1 + s.k) * (s.c * limit) * (s.c * limit));
    const double x = edge_of(c_x, s.a[1], limit);
    return {std::fmin(x * std::sqrt(1 + open_y), limit), std::fmin(y * std::sqrt(1 + open_x), limit)};
  }
  if (s.at->kind != kToroidal) return {limit, limit};
  if (c_x == 0) return {limit, y};
  double widest = 0;
  for (int i = 0; i <= 16; i++) {
    double at = i / 16.0 * y * (1 - 1e-8);
    widest = std::fmax(widest, 1 - c_x * height_at(s, 0, at).z);
  }
  return {std::fmin(widest / std::fabs(c_x), limit), y};
}

// The search along a ray, from its foot.
struct Search {
  const Surface<double>& s;
  const double x, y, z, L, M, N;

  Found newton(double t) const {
    const double rounding = std::numeric_limits<double>::epsilon();
    for (int step = 0; step < 24; step++) {
      Residual r = residual(t);
      if (r.dF == 0 || !std::isfinite(r.F)) break;
      t -= r.F / r.dF;
      if (!(std::fabs(r.F) > rounding * r.scale)) break;
    }
    Residual r = residual(t);
    return {t, is_small(r) && std::isfinite(t), r.dF * (N < 0 ? -1 : 1) > 0, std::sqrt(r.u)};
  }

  Residual residual(double t) const {
    const double hx = x + t * L, hy = y + t * M, hz = z + t * N;
    const Height at = height_at(s, hx, hy);
    double scale = std::fabs(hz) + at.size + std::fabs(z) + std::fabs(t * N);
    scale += (std::fabs(at.x) + std::fabs(at.y)) * (std::fabs(hx) + std::fabs(hy) + std::fabs(t));
    return {hz - at.z, N - (at.x * L + at.y * M), scale, hx * hx + hy * hy, at.inside};
  }

  // The path to the quadric that osculates at the vertex.
  double start() const {
    const double plane = std::fabs(N) > 1e-6 ? -z / N : 0;
    double t = plane;
    bool met = false;
    by_kind_of_terms(*s.at, [&](auto kind, auto count) { met = osculating<kind(), count()>(s).meets(x, y, z, L, M, N, t); });
    return met && std::hypot(x + t * L, y + t * M) <= s.rim ? t : plane;
  }

  // The part of the ray within a rim where a crossing may lie.
  Stretch stretch(double rim) const { return has_axis(s.at->kind) ? in_cylinder(rim) : in_box(rim); }

  // A stretch cut to where the ray is between two heights.
  Stretch between(double low, double high, double share, Stretch of) const {
    double margin = (high - low) * share + std::numeric_limits<double>::min();
    low -= margin, high += margin;
    if (std::fabs(N) > 1e-9) {
      double at_low = (low - z) / N, at_high = (high - z) / N;
      of.first = std::fmax(of.first, std::fmin(at_low, at_high));
      of.last = std::fmin(of.last, std::fmax(at_low, at_high));
    }
    return of;
  }

  double reach() const { return 4 * (std::sqrt(x * x + y * y) + std::fabs(z)); }

  // The first crossing in the direction of light on a stretch. A sign change counts only between points on the surface:
  // an end outside the domain has no F, so that the bisection ends at a crossing or at the edge of the domain, and the
  // residual tells them apart.
  bool bracketed(const Stretch& on, double& found_at) const {
    const int samples = 96, candidates = 4;
    if (!on.possible || !(on.last >= on.first)) return false;
    const double width = (on.last - on.first) / samples;
    Side before = side(on.first);
    for (int i = 1, tried = 0; i <= samples && tried < candidates; i++) {
      const double right = on.first + i * width;
      const Side after = side(right);
      const bool leaves = before == Side::before && after != Side::before;
      const bool enters = before == Side::outside && after == Side::behind;
      before = after;
      if (!leaves && !enters) continue;
      if (bisected(right - width, right, leaves, found_at)) return true;
      tried++;
    }
    return false;
  }

  bool operator()(double& t) const {
    const double rim = s.rim;
    Found found = newton(start());
    bool converged = found.small && found.forward;
    t = found.t;
    if (converged && found.radius <= rim) return true;
    if (bracketed(stretch(rim), t) || converged) return true;
    return rim < big() && bracketed(stretch(std::numeric_limits<double>::infinity()), t);
  }

 private:
  // Where light is on its way at t: before the surface, behind it, or where there is none.
  enum class Side { before, behind, outside };

  Side side(double t) const {
    const Residual r = residual(t);
    if (!r.inside) return Side::outside;
    return (N < 0 ? -r.F : r.F) <= 0 ? Side::before : Side::behind;
  }

  // Crossing between two points of which the left one is before the surface (leaves), or the right one behind it.
  bool bisected(double left, double right, bool leaves, double& found_at) const {
    const int bisections = 64;
    const double width = right - left;
    for (int i = 0; i < bisections; i++) {
      const double middle = 0.5 * (left + right);
      const Side at = side(middle);
      ((leaves ? at == Side::before : at != Side::behind) ? left : right) = middle;
    }
    const double t = leaves ? left : right;  // the end on the surface
    const Found polished = newton(t);
    const bool stayed = polished.small && polished.forward && std::fabs(polished.t - t) <= std::fabs(width);
    if (!stayed && !is_small(residual(t))) return false;
    found_at = stayed ? polished.t : t;
    return true;
  }

  static bool is_small(const Residual& r) {
    return std::fabs(r.F) <= 64 * std::numeric_limits<double>::epsilon() * r.scale && r.inside;
  }

  // In a cylinder, of a round sag.
  Stretch in_cylinder(double rim) const {
    double radius = std::fmin(edge_of(s.c, s.k, big()), rim);
    if (!(radius < big())) radius = reach();
    double low = std::numeric_limits<double>::infinity(), high = -low;
    for (int i = 0; i <= 64; i++) {
      double S = base_at(s, i / 64.0 * radius * (1 - 5e-8), 0).z;
      low = std::fmin(low, S), high = std::fmax(high, S);
    }
    const double added = has_sag_terms(s.at->kind) ? sag_terms_size(s, radius) : 0;
    double A = L * L + M * M, B = x * L + y * M, C = x * x + y * y - radius * radius;
    double discriminant = B * B - A * C, width = std::sqrt(std::fmax(discriminant, 0.0));
    Stretch of{-big(), big(), C <= 0};
    if (A > 0) of = {(-B - width) / A, (-B + width) / A, discriminant >= 0};
    return between(low - added, high + added, 0.05, of);
  }

  // In a box, of another one.
  Stretch in_box(double rim) const {
    const double infinity = std::numeric_limits<double>::infinity(), limit = rim < big() ? rim : reach();
    Extent side = extent_of(s, std::fmin(rim, big()));
    if (!(side.x < big())) side.x = limit;
    if (!(side.y < big())) side.y = limit;
    Stretch of{-big(), big(), true};
    auto cut = [&of](double at, double slope, double side) {
      if (slope == 0) {
        of.possible &= std::fabs(at) <= side;
        return;
      }
      double a = (-side - at) / slope, b = (side - at) / slope;
      of.first = std::fmax(of.first, std::fmin(a, b)), of.last = std::fmin(of.last, std::fmax(a, b));
    };
    cut(x, L, side.x), cut(y, M, side.y);
    double low = infinity, high = -infinity;
    for (int i = 0; i <= 8; i++)
      for (int j = 0; j <= 8; j++) {
        double S = height_at(s, i / 8.0 * (1 - 1e-8) * side.x, j / 8.0 * (1 - 1e-8) * side.y).z;
        low = std::fmin(low, S), high = std::fmax(high, S);
      }
    return between(low, high, 0.25, of);
  }
};

}  // namespace raytrace
