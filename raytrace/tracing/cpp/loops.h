// The surfaces as loops over a block: the algebra of raytrace/system/surface.py and trace.py where nothing can go wrong.
#pragma once
#include "sag_terms.h"

namespace raytrace {

// What a surface does to a ray that crosses it at h with cosine n·d: Snell or the law of reflection (trace.py).
template <typename T, int bend>
struct Law {
  T mu, D, over_n2, n1;
  explicit Law(const Surface<T>& s)
      : mu(s.n1 / s.n2), D((s.n2 - s.n1) * (s.n2 + s.n1)), over_n2(T(1) / s.n2), n1(s.n1) {}

  // Turns (L, M, N); false where no light passes, or float32 cannot tell.
  inline bool operator()(T& L, T& M, T& N, T nx, T ny, T nz, T cosine, T norm_squared) const {
    bool passes = true;
    T along, keep;
    if (bend == kRefract) {
      T a = n1 * cosine;
      T b_squared = a * a + D * norm_squared;
      passes = b_squared > kCritical<T>;
      T b = signed_as(root(passes ? b_squared : T(1)), a);
      along = D * over_n2 / (a + b);
      keep = mu;
    } else {
      along = T(-2) * cosine / norm_squared;
      keep = T(1);
    }
    T l = keep * L + along * nx, m = keep * M + along * ny, n = keep * N + along * nz;
    T factor = T(1.5) - T(0.5) * (l * l + m * m + n * n);
    L = l * factor, M = m * factor, N = n * factor;
    return passes;
  }
};

// n · path less the axial ray's, see `_reduced_path`; z is that before the gap, side the axial direction of light.
template <typename T>
inline T reduced_path(T hx, T hy, T hz, T x, T y, T z, T L, T M, T N, T gap, bool has_gap, T side) {
  T path = (hx - x) * L + (hy - y) * M + (hz - z) * N;
  if (!has_gap) return path;
  T forward = T(1) + side * N;
  bool usual = side * N > 0;
  T lag = usual ? -side * (L * L + M * M) / (usual ? forward : T(1)) : N - side;
  return path + gap * lag;
}

// Ray i behind a surface; 1 if it is flagged.
template <typename T>
inline int leave(Rays<T>& to, Notes<T>& notes, int i, T x, T y, T z, T L, T M, T N, bool good) {
  to.x[i] = x, to.y[i] = y, to.z[i] = z;
  to.L[i] = L, to.M[i] = M, to.N[i] = N;
  notes.flagged[i] = good ? T(0) : T(1);
  return good ? 0 : 1;
}

template <typename T, int bend, bool path>
int cross_plane(const Rays<T>& from, Rays<T>& to, Notes<T>& notes, int n, const Surface<T>& s) {
  const Law<T, bend> law(s);
  const bool has_gap = s.at->gap >= 0;
  const T gap = s.gap, side = T(s.at->side);
  int flagged = 0;
#pragma omp simd reduction(+ : flagged)
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T t = (z - gap) / N;
    T hx = x - t * L, hy = y - t * M;
    bool good = magnitude(t) < kFar<T>;
    T l = L, m = M, o = N;
    if (bend != kNone) good &= law(l, m, o, T(0), T(0), T(1), N, T(1));
    if (path) to.path[i] = from.path[i] + s.n1 * reduced_path(hx, hy, T(0), x, y, z, L, M, N, gap, has_gap, side);
    flagged += leave(to, notes, i, hx, hy, T(0), l, m, o, good);
  }
  return flagged;
}

// A sphere: G = N and A = c at the foot of the perpendicular, and the root is n·d itself.
template <typename T, int bend, bool path, bool conic>
int cross_conic(const Rays<T>& from, Rays<T>& to, Notes<T>& notes, int n, const Surface<T>& s) {
  const Law<T, bend> law(s);
  const bool has_gap = s.at->gap >= 0;
  const T gap = s.gap, side = T(s.at->side), c = s.c, shape = T(1) + s.k;
  int flagged = 0;
#pragma omp simd reduction(+ : flagged)
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i];
    T slide = x * L + y * M + (z - gap) * N;
    T px = x - slide * L, py = y - slide * M, pz = (z - gap) - slide * N;
    T A, G, F;
    if (conic) {
      A = c * (L * L + M * M + shape * N * N);
      G = N - c * (px * L + py * M + shape * pz * N);
      F = c * (px * px + py * py + shape * pz * pz) - T(2) * pz;
    } else {
      A = c, G = N, F = c * (px * px + py * py + pz * pz) - T(2) * pz;
    }
    T discriminant = G * G - A * F;
    bool good = discriminant > kGrazing<T> * G * G;
    T cosine = signed_as(root(good ? discriminant : T(1)), N);
    T t = F / (G + cosine);
    T hx = px + t * L, hy = py + t * M, hz = pz + t * N;
    T nz = T(1) - shape * c * hz;
    good &= nz > T(1) - kEdge<T>;
    if (conic) good &= magnitude(t) < kFar<T>;
    // On the nearer side of a sphere's equator n_z is at most 2; and G must not cancel against the root.
    good &= conic ? G * N > T(0.01) * N * N : nz < T(1) + kEdge<T>;
    T l = L, m = M, o = N;
    if (bend != kNone) {
      T w = conic ? T(1) - s.k * c * c * (hx * hx + hy * hy) : T(1);
      good &= law(l, m, o, -c * hx, -c * hy, nz, cosine, w);
    }
    if (path) to.path[i] = from.path[i] + s.n1 * reduced_path(hx, hy, hz, x, y, z, L, M, N, gap, has_gap, side);
    flagged += leave(to, notes, i, hx, hy, hz, l, m, o, good);
  }
  return flagged;
}

// Newton's method from the base conic, every ray frozen once its step is small: quadratic convergence then puts the
// error below rounding. Rays that take more than a few steps are left to `careful`.
template <typename T>
constexpr T kSmallStep = sizeof(T) == 4 ? T(2e-5) : T(1e-9);
constexpr int kSteps = 8;

// |F| of a hit over the size of its terms, above which it is left to `careful`: where a section closes its slope has no
// bound, and steps vanish far from the surface.
template <typename T>
constexpr T kOff = sizeof(T) == 4 ? T(1e-4) : T(1e-10);

// How far beyond the rim a loop follows rays.
template <typename T>
constexpr T kBeyond = T(1.125);

// cos² of the angle to the axis above which a ray crosses a round sag with its sag terms only once up to a radius: it runs
// more steeply than the surface stands anywhere there. NaN or 1 where there is no such angle.
template <int kind, typename T>
T single_crossing(const Surface<T>& s, T radius) {
  constexpr bool odd = SagOf<kind>::odd;
  const T bent = s.c * radius;  // the slope of a conic rises outwards
  T slope = magnitude(bent) / root(T(1) - (T(1) + s.k) * bent * bent), power = odd ? T(1) : radius;
  for (int j = 0; j < s.at->terms; j++) {
    slope += T(odd ? j + 1 : 2 * j + 2) * magnitude(s.a[j]) * power;
    power *= odd ? radius : radius * radius;
  }
  if constexpr (has_sag_terms(kind)) slope += sag_terms_slope(s, radius);
  return T(1) - T(1) / (T(1) + slope * slope);
}

template <typename T, int kind, int terms>
void newton(const Rays<T>& from, Notes<T>& notes, int n, const Surface<T>& s) {
  const T gap = s.gap, rim = T(s.rim) * (is_round<kind>() ? kBeyond<T> : T(1)), rim_squared = rim * rim;
  const auto quadric = osculating<kind, terms>(s);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i] - gap, L = from.L[i], M = from.M[i], N = from.N[i];
    T slide = x * L + y * M + z * N;
    T px = x - slide * L, py = y - slide * M, pz = z - slide * N;
    T t;
    bool usable = quadric.meets(px, py, pz, L, M, N, t);
    T hx = px + t * L, hy = py + t * M;
    bool within = hx * hx + hy * hy <= rim_squared;
    bool flat = magnitude(N) > T(1e-6);
    T plane = flat ? -pz / (flat ? N : T(1)) : T(0);
    notes.px[i] = px, notes.py[i] = py, notes.pz[i] = pz;
    notes.t[i] = usable & within ? t : plane;
    notes.active[i] = T(1);
  }
  for (int step = 0; step < kSteps; step++) {
    int going = 0;
    if constexpr (has_sag_terms(kind)) sag_terms_along(from, notes, n, s);
#pragma omp simd reduction(+ : going)
    for (int i = 0; i < n; i++) {
      T L = from.L[i], M = from.M[i], N = from.N[i], t = notes.t[i];
      T x = notes.px[i] + t * L, y = notes.py[i] + t * M, z = notes.pz[i] + t * N;
      T u = x * x + y * y;
      const auto S = whole_sag_at<kind, terms, kStill, kNoRows>(s, notes.added, i, x, y);
      T change = (z - S.v) / (N - (S.d[kX] * L + S.d[kY] * M));
      bool active = notes.active[i] > 0;
      notes.t[i] = active ? t - change : t;
      bool more = active & !(change * change <= kSmallStep<T> * kSmallStep<T> * (u + z * z));
      notes.active[i] = more ? T(1) : T(0);
      going += more ? 1 : 0;
    }
    if (!going) break;
  }
}

template <typename T, int kind, int bend, bool path, int terms>
int cross_asphere(const Rays<T>& from, Rays<T>& to, Notes<T>& notes, int n, const Surface<T>& s) {
  newton<T, kind, terms>(from, notes, n, s);
  if constexpr (has_sag_terms(kind)) sag_terms_along(from, notes, n, s);
  const Law<T, bend> law(s);
  const bool has_gap = s.at->gap >= 0;
  const T gap = s.gap, side = T(s.at->side), rim_squared = T(s.rim) * T(s.rim);
  const T beyond = kBeyond<T> * T(s.rim), beyond_squared = beyond * beyond;
  T single = 1;
  if constexpr (is_round<kind>()) single = single_crossing<kind>(s, beyond);
  int flagged = 0;
#pragma omp simd reduction(+ : flagged)
  for (int i = 0; i < n; i++) {
    T x = from.x[i], y = from.y[i], z = from.z[i], L = from.L[i], M = from.M[i], N = from.N[i], t = notes.t[i];
    T hx = notes.px[i] + t * L, hy = notes.py[i] + t * M, hz = notes.pz[i] + t * N;
    T u = hx * hx + hy * hy;
    const auto S = whole_sag_at<kind, terms, kStill, kNoRows>(s, notes.added, i, hx, hy);
    T off = hz - S.v, size = magnitude(hz) + magnitude(S.v), nx = -S.d[kX], ny = -S.d[kY];
    T cosine = N + nx * L + ny * M, w = T(1) + nx * nx + ny * ny;
    bool good = S.inside;
    if constexpr (has_sag_terms(kind)) size += magnitude(notes.added.p[i]);
    // `active` is 1 where Newton's method has not arrived, and NaN compares as false.
    good &= (notes.active[i] < T(0.5)) & (cosine * N > 0);
    good &= (u <= rim_squared) | ((u <= beyond_squared) & (N * N > single));
    good &= cosine * cosine > kGrazing<T> * T(0.1) * w;
    good &= magnitude(off) <= kOff<T> * (size + root(u));
    T l = L, m = M, o = N;
    if (bend != kNone) good &= law(l, m, o, nx, ny, T(1), cosine, w);
    if (path) to.path[i] = from.path[i] + s.n1 * reduced_path(hx, hy, hz, x, y, z, L, M, N, gap, has_gap, side);
    flagged += leave(to, notes, i, hx, hy, hz, l, m, o, good);
  }
  return flagged;
}

// The normals of a surface where rays stand on it, and their squared lengths, in notes.normal.
template <typename T, int kind, int terms>
void normals(const Rays<T>& at, Notes<T>& notes, int n, const Surface<T>& s) {
  Normals<T>& to = notes.normal;
  if constexpr (has_sag_terms(kind)) sag_terms_on<false>(at, notes, n, s);
#pragma omp simd
  for (int i = 0; i < n; i++) {
    const auto F = face_at<kind, terms, kStill, kNoRows>(s, notes.added, i, at.x[i], at.y[i], at.z[i]);
    T nx = as<T>(BY(F, kX)), ny = as<T>(BY(F, kY)), nz = as<T>(BY(F, kZ));
    to.x[i] = nx, to.y[i] = ny, to.z[i] = nz, to.w[i] = nx * nx + ny * ny + nz * nz;
  }
}

}  // namespace raytrace
