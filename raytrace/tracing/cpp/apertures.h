// The shapes of apertures: raytrace/system/aperture.py. A new shape is one more `Shape`, in the order of the `code` of its
// row there, and a case of `inside`.
#pragma once
#include "block.h"

namespace raytrace {

enum Shape { kCircular, kRectangular, kElliptic, kPolygon };

// An aperture as structure.py writes it into the constants; its sizes follow.
struct Aperture {
  double shape, obscures, x, y, count;
  const double* sizes() const { return reinterpret_cast<const double*>(this + 1); }
  const Aperture* next() const { return reinterpret_cast<const Aperture*>(sizes() + int(count)); }
};

// Where a point lies: within the shape, its edge included, and strictly inside it.
struct Place { bool within, blocked; };

// Polygons by their corners, each closed by its first one, the last anyhow: within an odd number of them, or on a side.
template <typename T>
inline Place in_polygons(T x, T y, const double* corners, int count) {
  bool odd = false, on_side = false;
  for (int first = 0, k = 1; 2 * first < count; k++) {
    const bool last = 2 * k >= count;
    const int from = 2 * (k - 1), to = 2 * (last ? first : k);
    const T x1 = T(corners[from]), y1 = T(corners[from + 1]), x2 = T(corners[to]), y2 = T(corners[to + 1]);
    const T dx = x2 - x1, dy = y2 - y1, length = dx * dx + dy * dy;
    T share = ((x - x1) * dx + (y - y1) * dy) / (length > 0 ? length : T(1));
    share = share < 0 ? T(0) : share > 1 ? T(1) : share;
    on_side |= x - x1 - share * dx == 0 && y - y1 - share * dy == 0;
    if (y1 != y2) odd ^= ((y1 > y) != (y2 > y)) && x < x1 + (y - y1) * (dx / dy);
    if (last) break;
    if (x2 == T(corners[2 * first]) && y2 == T(corners[2 * first + 1])) first = k + 1, k = first;
  }
  return {odd || on_side, odd && !on_side};
}

template <int shape, typename T>
inline Place inside(T x, T y, const double* sizes, int count) {
  if (shape == kPolygon) return in_polygons(x, y, sizes, count);
  const T a = T(sizes[0]), b = T(sizes[1]);
  if (shape == kCircular) {
    T r = x * x + y * y;
    return {r >= a * a && r <= b * b, (a > 0 ? r > a * a : r >= 0) && r < b * b};
  }
  if (shape == kRectangular) return {magnitude(x) <= a && magnitude(y) <= b, magnitude(x) < a && magnitude(y) < b};
  T level = (x / a) * (x / a) + (y / b) * (y / b);
  return {level <= 1, level < 1};
}

template <int shape, typename T>
void clip_by(const Aperture& aperture, const Rays<T>& rays, uint8_t* valid, int n) {
  const T cx = T(aperture.x), cy = T(aperture.y);
  for (int i = 0; i < n; i++) {
    Place at = inside<shape>(rays.x[i] - cx, rays.y[i] - cy, aperture.sizes(), int(aperture.count));
    valid[i] &= aperture.obscures != 0 ? !at.blocked : at.within;
  }
}

// A ray passes all `count` apertures of a surface (aperture.py, `passes`).
template <typename T>
void clip(const Rays<T>& rays, uint8_t* valid, int n, const double* constants, int count) {
  const Aperture* aperture = reinterpret_cast<const Aperture*>(constants);
  for (; count > 0; count--, aperture = aperture->next()) {
    const int shape = int(aperture->shape);
    if (shape == kCircular) clip_by<kCircular>(*aperture, rays, valid, n);
    else if (shape == kRectangular) clip_by<kRectangular>(*aperture, rays, valid, n);
    else if (shape == kPolygon) clip_by<kPolygon>(*aperture, rays, valid, n);
    else clip_by<kElliptic>(*aperture, rays, valid, n);
  }
}

}  // namespace raytrace
