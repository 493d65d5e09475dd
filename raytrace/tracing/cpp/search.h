// First crossing with a surface that is more than a conic, raytrace/system/search.py line by line: Newton's method from the
// base quadric, accepted by a residual relative to the size of the terms, and a bracketed search for the rays that fail.
#pragma once
#include <algorithm>
#include <utility>

#include "loops.h"

namespace raytrace {

struct Residual { double F, dF, scale, u; bool inside; };
struct Found { double t; bool small, forward; double radius; };
struct Stretch { double first, last; bool possible; };

inline double big() { return std::pow(std::numeric_limits<double>::max(), 0.48); }  // its square is a number

// What searches share. Own has the members of `AsphereSearch`: the surface, a ray from its foot, `residual`, `start` and
// `stretch`, which is the part of the ray within a rim where a crossing may lie.
template <typename Own>
struct Search {
  Found newton(double t) const {
    const double rounding = std::numeric_limits<double>::epsilon();
    for (int step = 0; step < 24; step++) {
      Residual r = own().residual(t);
      if (r.dF == 0 || !std::isfinite(r.F)) break;
      t -= r.F / r.dF;
      if (!(std::fabs(r.F) > rounding * r.scale)) break;
    }
    Residual r = own().residual(t);
    return {t, is_small(r) && std::isfinite(t), r.dF * (own().N < 0 ? -1 : 1) > 0, std::sqrt(r.u)};
  }

  // The start by the quadric A t² - 2 G t + F = 0.
  double quadric(double A, double G, double F) const {
    const Own& ray = own();
    double plane = std::fabs(ray.N) > 1e-6 ? -ray.z / ray.N : 0, discriminant = G * G - A * F;
    if (!(discriminant > 0) || !(G * ray.N > 0)) return plane;
    double t = F / (G + signed_as(std::sqrt(discriminant), ray.N));
    return std::hypot(ray.x + t * ray.L, ray.y + t * ray.M) <= ray.s.rim ? t : plane;
  }

  // A stretch cut to where the ray is between two heights.
  Stretch between(double low, double high, double share, Stretch of) const {
    double margin = (high - low) * share + std::numeric_limits<double>::min();
    low -= margin, high += margin;
    if (std::fabs(own().N) > 1e-9) {
      double at_low = (low - own().z) / own().N, at_high = (high - own().z) / own().N;
      of.first = std::fmax(of.first, std::fmin(at_low, at_high));
      of.last = std::fmin(of.last, std::fmax(at_low, at_high));
    }
    return of;
  }

  double reach() const {
    const Own& ray = own();
    return 4 * (std::sqrt(ray.x * ray.x + ray.y * ray.y) + std::fabs(ray.z));
  }

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
    const double rim = own().s.rim;
    Found found = newton(own().start());
    bool converged = found.small && found.forward;
    t = found.t;
    if (converged && found.radius <= rim) return true;
    if (bracketed(own().stretch(rim), t) || converged) return true;
    return rim < big() && bracketed(own().stretch(std::numeric_limits<double>::infinity()), t);
  }

 private:
  // Where light is on its way at t: before the surface, behind it, or where there is none.
  enum class Side { before, behind, outside };

  Side side(double t) const {
    const Residual r = own().residual(t);
    if (!r.inside) return Side::outside;
    return (own().N < 0 ? -r.F : r.F) <= 0 ? Side::before : Side::behind;
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
    if (!stayed && !is_small(own().residual(t))) return false;
    found_at = stayed ? polished.t : t;
    return true;
  }

  static bool is_small(const Residual& r) {
    return std::fabs(r.F) <= 64 * std::numeric_limits<double>::epsilon() * r.scale && r.inside;
  }

  const Own& own() const { return static_cast<const Own&>(*this); }
};

struct AsphereSearch : Search<AsphereSearch> {
  const Surface<double>& s;
  double x, y, z, L, M, N;
  AsphereSearch(const Surface<double>& s, double x, double y, double z, double L, double M, double N)
      : s(s), x(x), y(y), z(z), L(L), M(M), N(N) {}

  Residual residual(double t) const {
    double hx = x + t * L, hy = y + t * M, hz = z + t * N, u = hx * hx + hy * hy;
    auto [S, dS, size, inside] = slope_at(s, u);
    double radial = hx * L + hy * M;
    double scale = std::fabs(hz) + std::fabs(s.c * u) + size + std::fabs(z) + std::fabs(t * N);
    scale += 2 * std::fabs(dS) * (u + std::fabs(radial) * std::fabs(t));
    return {hz - S, N - 2 * dS * radial, scale, u, inside};
  }

  double start() const {
    double shape = 1 + s.k;
    double A = s.c * (L * L + M * M + shape * N * N);
    double G = N - s.c * (x * L + y * M + shape * z * N);
    double F = s.c * (x * x + y * y + shape * z * z) - 2 * z;
    return quadric(A, G, F);
  }

  Stretch stretch(double rim) const {
    const double within = radius(rim);
    auto [low, high] = heights(within);
    return between(low, high, 0.05, cylinder(within));
  }

  // How far out a crossing is looked for.
  double radius(double rim) const {
    double closed = (1 + s.k) * s.c * s.c, edge = closed > 0 ? 1 / std::sqrt(closed) : big();
    double radius = edge < big() ? std::fmin(edge, rim) : rim;
    return radius < big() ? radius : reach();
  }

  // Where the ray is in the cylinder of a radius.
  Stretch cylinder(double radius) const {
    double A = L * L + M * M, B = x * L + y * M, C = x * x + y * y - radius * radius;
    double discriminant = B * B - A * C, width = std::sqrt(std::fmax(discriminant, 0.0));
    return {A > 0 ? (-B - width) / A : -big(), A > 0 ? (-B + width) / A : big(), A > 0 ? discriminant >= 0 : C <= 0};
  }

  // The lowest and the highest sag within a radius.
  std::pair<double, double> heights(double radius) const {
    double low = std::numeric_limits<double>::infinity(), high = -low;
    for (int i = 0; i <= 64; i++) {
      double at = i / 64.0 * radius, S = slope_at(s, at * at * (1 - 1e-7)).S;
      low = std::fmin(low, S), high = std::fmax(high, S);
    }
    return {low, high};
  }
};

// A sag that is not round at a point, with its slopes; size: what it adds up from. Beyond its edge it is held there.
struct Height { double z, x, y, size; bool inside; };

inline Height height_at(const Surface<double>& s, double x, double y) {
  Height found{};
  const double c_x = s.a[0];
  by_kind_of_terms(*s.at, [&](auto kind, auto terms) {
    if constexpr (is_freeform(kind())) {
      const auto sheet = sheet_at<kind(), terms(), false>(s, x, y);
      found = {sheet.z, sheet.x, sheet.y, std::fabs(s.c * y * y) + std::fabs(c_x * x * x), sheet.inside};
      if constexpr (kind() == kToroidal) {
        for (int j = s.at->terms - 1; j >= 1; j--) found.size += std::fabs(s.a[j]) * std::pow(y * y, j);
        if (!sheet.reached && c_x != 0) found.z = 1 / c_x, found.x = found.y = 0;
      } else if (!sheet.inside) {  // as it would go on with w = 0
        found.x = 2 * c_x * x, found.y = 2 * s.c * y, found.z = 0.5 * (x * found.x + y * found.y);
      }
    }
  });
  return found;
}

// The same of a round sag with sag terms.
[[gnu::noinline]] inline Height departed_at(const Surface<double>& s, double x, double y) {
  const Slope base = slope_at(s, x * x + y * y);
  const Added<double, 1> D = sag_terms_at(s, x, y);
  return {base.S + D.p[0], 2 * base.dS * x + D.x[0], 2 * base.dS * y + D.y[0], base.size, base.inside};
}

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
  if (c_x == 0) return {limit, y};
  double widest = 0;
  for (int i = 0; i <= 16; i++) {
    double at = i / 16.0 * y * (1 - 1e-8);
    widest = std::fmax(widest, 1 - c_x * height_at(s, 0, at).z);
  }
  return {std::fmin(widest / std::fabs(c_x), limit), y};
}

// A round sag with sag terms: that of the sag alone, and what the sag terms adds.
struct DepartedSearch : Search<DepartedSearch> {
  const AsphereSearch round;
  const Surface<double>& s;
  double x, y, z, L, M, N;
  DepartedSearch(const Surface<double>& s, double x, double y, double z, double L, double M, double N)
      : round(s, x, y, z, L, M, N), s(s), x(x), y(y), z(z), L(L), M(M), N(N) {}

  Residual residual(double t) const {
    Residual found = round.residual(t);
    const double hx = x + t * L, hy = y + t * M;
    const Added<double, 1> D = sag_terms_at(s, hx, hy);
    found.F -= D.p[0], found.dF -= D.x[0] * L + D.y[0] * M;
    found.scale += sag_terms_size(s, std::sqrt(found.u));
    found.scale += (std::fabs(D.x[0]) + std::fabs(D.y[0])) * (std::fabs(hx) + std::fabs(hy) + std::fabs(t));
    return found;
  }

  double start() const { return round.start(); }

  Stretch stretch(double rim) const {
    double radius = round.radius(rim), beside = sag_terms_size(s, radius);
    auto [low, high] = round.heights(radius);
    return between(low - beside, high + beside, 0.05, round.cylinder(radius));
  }
};

struct FreeformSearch : Search<FreeformSearch> {
  const Surface<double>& s;
  double x, y, z, L, M, N;
  FreeformSearch(const Surface<double>& s, double x, double y, double z, double L, double M, double N)
      : s(s), x(x), y(y), z(z), L(L), M(M), N(N) {}

  Residual residual(double t) const {
    double hx = x + t * L, hy = y + t * M, hz = z + t * N;
    const Height at = height_at(s, hx, hy);
    double scale = std::fabs(hz) + at.size + std::fabs(z) + std::fabs(t * N);
    scale += (std::fabs(at.x) + std::fabs(at.y)) * (std::fabs(hx) + std::fabs(hy) + std::fabs(t));
    return {hz - at.z, N - (at.x * L + at.y * M), scale, hx * hx + hy * hy, at.inside};
  }

  double start() const {
    double c_x = s.a[0], c_y = s.at->kind == kToroidal ? curvature_along_y<kToroidal>(s) : s.c;
    double c_z = std::fabs(c_x * x * x) > std::fabs(c_y * y * y) ? c_x : c_y;
    return quadric(c_x * L * L + c_y * M * M + c_z * N * N, N - (c_x * x * L + c_y * y * M + c_z * z * N),
                   c_x * x * x + c_y * y * y + c_z * z * z - 2 * z);
  }

  Stretch stretch(double rim) const {
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
