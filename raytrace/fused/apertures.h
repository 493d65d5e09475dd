// The shapes of apertures: raytrace/system/aperture.py. A new shape is one more `Shape`, in the order of the `code` of its
// row there, and a case of `inside`.
#pragma once
#include "block.h"

namespace raytrace {

enum Shape { kCircular, kRectangular, kElliptic };

// An aperture as structure.py writes it into the constants; its sizes follow.
struct Aperture {
  double shape, obscures, x, y, count;
  const double* sizes() const { return reinterpret_cast<const double*>(this + 1); }
  const Aperture* next() const { return reinterpret_cast<const Aperture*>(sizes() + int(count)); }
};

// Where a point lies: within the shape, its edge included, and strictly inside it.
struct Place { bool within, blocked; };

template <int shape, typename T>
inline Place inside(T x, T y, const double* sizes, int) {
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
    else clip_by<kElliptic>(*aperture, rays, valid, n);
  }
}

}  // namespace raytrace
