// Sags that differ along x and y by their kind, raytrace/system/shapes.py: at a point, with what their derivatives and
// their numbers do. A kind is a `Sheet`, in `by_kind_of_terms` of sags.h and `sheet_at`.
//
//     toroidal   z = g + c_x x²/(q + w),  w = √(q² - c_x² x²) = 1 - c_x z,  q = 1 - c_x g,  g = g(y); a[0] is c_x
//     biconic    z (1 + w) = c_x x² + c y²,  w² = 1 - (1+k_x) c_x² x² - (1+k) c² y²; a[0] is c_x, a[1] is k_x
#pragma once
#include "sags.h"

namespace raytrace {

// How z and its slopes change by one number.
template <typename T>
struct Turned { T z, x, y; };

// What the numbers of a sheet get from a ray.
template <typename T>
struct Shares { T c, k, first, second, height, slope; };  // of a[0] and a[1]; height, slope: of the terms in y²

template <typename T, int terms>
struct Toroid {
  T hx, hy, c, k, c_x;
  T z, x, y, xx, xy, yy;  // the sag and its derivatives
  bool inside, reached;  // reached: whether the circle about the axis gets as far out as x
  T u, over_s, share_s, g, dS, dg, q, over_w, turn;  // over_s, share_s: 1/√ of the section along y, 1/(1 + √)

  template <int second>
  void at(const Surface<T>& s, T px, T py, Constant<second>) {
    hx = px, hy = py, c = s.c, k = s.k, c_x = s.a[0], u = hy * hy;
    T shape = T(1) + k, radicand = T(1) - shape * c * c * u, d2S = 0;
    bool open = radicand > 0;
    T root_s = root(open ? radicand : std::numeric_limits<T>::min());
    T both_s = T(1) / (root_s * (T(1) + root_s));  // one division for two
    over_s = (T(1) + root_s) * both_s, share_s = root_s * both_s;
    g = c * u * share_s, dS = T(0.5) * c * over_s;
    series<second>(s.a + 1, terms - 1, u, g, dS, d2S);
    dg = T(2) * dS * hy;
    T p = c_x * hx;
    q = T(1) - c_x * g;
    reached = q > magnitude(p), inside = open & reached;
    q = reached ? q : T(1), p = reached ? p : T(0);
    T w = root((q - p) * (q + p));
    T both = T(1) / (w * (q + w));
    over_w = (q + w) * both;
    z = g + hx * p * w * both, x = p * over_w, y = q * over_w * dg;
    if (second) {
      T tilt = c * over_s * hy;
      T d2g = T(2) * dS + shape * c * over_s * tilt * tilt + T(4) * d2S * u;
      turn = c_x * over_w;
      xx = turn * (T(1) + x * x), xy = turn * x * y, yy = q * over_w * d2g + turn * (y * y - dg * dg);
    }
  }

  // From the cotangents of z and its slopes.
  Shares<T> pulled(T gz, T gx, T gy) const {
    T height = q * over_w * (gz + turn * (gx * x + gy * y)) - gy * turn * dg, slope = gy * q * over_w;
    T gdS = T(2) * slope * hy, third = over_s * over_s * over_s, conic_sag = c * u * share_s;
    Shares<T> to{};
    to.c = T(0.5) * gdS * third + height * u * over_s * share_s;
    to.k = T(0.25) * gdS * c * c * c * u * third + T(0.5) * height * c * conic_sag * conic_sag * over_s;
    T by_c = T(0.5) * over_w * (hx * hx + z * z - g * g), w_c = -(z + c_x * by_c);
    to.first = gz * by_c + over_w * (gx * (hx - x * w_c) - gy * (g * dg + y * w_c));
    to.height = height, to.slope = gdS;
    return to;
  }

  // By changes of the numbers.
  Turned<T> pushed(T dc, T dk, const T* da) const {
    T third = over_s * over_s * over_s, conic_sag = c * u * share_s, P = 0, dP = 0, d2P = 0;
    series<false>(da + 1, terms - 1, u, P, dP, d2P);
    T height = dc * u * over_s * share_s + T(0.5) * dk * c * conic_sag * conic_sag * over_s + P;
    T slope = T(2) * hy * (T(0.5) * dc * third + T(0.25) * dk * c * (c * c * u) * third + dP);
    T by_c = T(0.5) * over_w * (hx * hx + z * z - g * g), w_c = -(z + c_x * by_c), lift = q * over_w * height;
    return {lift + da[0] * by_c, turn * x * lift + da[0] * over_w * (hx - x * w_c),
            turn * (y * lift - dg * height) + q * over_w * slope - da[0] * over_w * (g * dg + y * w_c)};
  }
};

// E = z - g - c_x (x² + z² - g²)/2, which is 0 on a toroid, along a ray: E/E' with one division, or the normal ∇E, which
// needs no second root: (-c_x x, -q g', 1 - c_x z).
// In float64, where roots and divisions are what a crossing costs; in float32 the sag itself is faster.
template <typename T>
constexpr bool has_ring(int kind) { return kind == kToroidal && sizeof(T) == 8; }

template <typename T, int terms>
struct Ring {
  T root_s, scale, g, dg;  // g and g' times the scale
  bool open;

  Ring(const Surface<T>& s, T y) {
    T c = s.c, u = y * y, radicand = T(1) - (T(1) + s.k) * c * c * u, P = 0, dP = 0, d2P = 0;
    open = radicand > 0;
    root_s = root(open ? radicand : std::numeric_limits<T>::min());
    scale = root_s * (T(1) + root_s);
    series<false>(s.a + 1, terms - 1, u, P, dP, d2P);
    g = c * u * root_s + P * scale, dg = y * (c * (T(1) + root_s) + T(2) * dP * scale);
  }

  T newton(T c_x, T x, T z, T L, T M, T N) const {
    T square = scale * scale;
    T E = (z - T(0.5) * c_x * (x * x + z * z)) * square - g * scale + T(0.5) * c_x * g * g;
    return E / (((T(1) - c_x * z) * N - c_x * x * L) * square - (scale - c_x * g) * dg * M);
  }
};

template <typename T>
struct Biconic {
  T hx, hy, c, c_x, shape, shape_x;
  T z, x, y, xx, xy, yy;
  bool inside;
  T over_w, share, w_x, w_y;

  template <int second>
  void at(const Surface<T>& s, T px, T py, Constant<second>) {
    hx = px, hy = py, c = s.c, c_x = s.a[0], shape = T(1) + s.k, shape_x = T(1) + s.a[1];
    T p = c_x * hx, q = c * hy, radicand = T(1) - shape_x * (p * p) - shape * (q * q);
    inside = radicand > 0;
    T w = root(inside ? radicand : T(1));
    share = T(1) / (T(1) + w), over_w = T(1) / w;
    z = (hx * p + hy * q) * share;
    w_x = -shape_x * c_x * p * over_w, w_y = -shape * c * q * over_w;
    x = (T(2) * p - z * w_x) * share, y = (T(2) * q - z * w_y) * share;
    if (second) {
      T w_xx = -(shape_x * c_x * c_x + w_x * w_x) * over_w, w_yy = -(shape * c * c + w_y * w_y) * over_w;
      xx = (T(2) * c_x - T(2) * x * w_x - z * w_xx) * share, yy = (T(2) * c - T(2) * y * w_y - z * w_yy) * share;
      xy = -(x * w_y + y * w_x - z * w_x * w_y * over_w) * share;
    }
  }

  // By a number of which top = ∂(c_x x² + c y²) and w change like this, across and along: ∂²/∂x and ∂²/∂y of top, and
  // of half w² (less what w itself does).
  Turned<T> by(T top, T w_d, T top_x, T top_y, T half_x, T half_y) const {
    T z_d = (top - z * w_d) * share, w_xd = (half_x - w_d * w_x) * over_w, w_yd = (half_y - w_d * w_y) * over_w;
    return {z_d, (top_x - x * w_d - z_d * w_x - z * w_xd) * share, (top_y - y * w_d - z_d * w_y - z * w_yd) * share};
  }
  Turned<T> by_curvature_x() const {
    T p = c_x * hx;
    return by(hx * hx, -shape_x * p * hx * over_w, T(2) * hx, T(0), T(-2) * shape_x * p, T(0));
  }
  Turned<T> by_curvature() const {
    T q = c * hy;
    return by(hy * hy, -shape * q * hy * over_w, T(0), T(2) * hy, T(0), T(-2) * shape * q);
  }
  Turned<T> by_conic_x() const {
    T p = c_x * hx;
    return by(T(0), T(-0.5) * p * p * over_w, T(0), T(0), -c_x * p, T(0));
  }
  Turned<T> by_conic() const {
    T q = c * hy;
    return by(T(0), T(-0.5) * q * q * over_w, T(0), T(0), T(0), -c * q);
  }

  Shares<T> pulled(T gz, T gx, T gy) const {
    auto dot = [=](const Turned<T>& d) { return gz * d.z + gx * d.x + gy * d.y; };
    Shares<T> to{};
    to.c = dot(by_curvature()), to.k = dot(by_conic()), to.first = dot(by_curvature_x()), to.second = dot(by_conic_x());
    return to;
  }

  Turned<T> pushed(T dc, T dk, const T* da) const {
    const Turned<T> a = by_curvature(), b = by_conic(), d = by_curvature_x(), e = by_conic_x();
    return {dc * a.z + dk * b.z + da[0] * d.z + da[1] * e.z, dc * a.x + dk * b.x + da[0] * d.x + da[1] * e.x,
            dc * a.y + dk * b.y + da[0] * d.y + da[1] * e.y};
  }
};

template <typename T, int kind, int terms>
using SheetOf = std::conditional_t<kind == kToroidal, Toroid<T, terms>, Biconic<T>>;

template <int kind, int terms, bool second, typename T>
inline SheetOf<T, kind, terms> sheet_at(const Surface<T>& s, T x, T y) {
  SheetOf<T, kind, terms> sheet{};
  sheet.at(s, x, y, Constant<second>{});
  return sheet;
}

// The curvature at the vertex along y.
template <int kind, typename T>
inline T curvature_along_y(const Surface<T>& s) { return kind == kToroidal ? s.c + T(2) * s.a[1] : s.c; }

}  // namespace raytrace
