// The limit of this machine: the arithmetic of the trace as one would write it for one lens alone, by hand, in C++.
//
// Blocks of rays, a few hundred, stay in the first cache; components lie in arrays of their own, so that the compiler
// turns every loop into vector instructions. One loop for each kind of surface, nothing tested that the kind decides.
//
// Safe: what the eager trace computes. Foot of the perpendicular, the root that does not cancel, one step of Newton's
// method in float64, Snell by (n2 - n1)(n2 + n1), directions brought back to length 1, and for every ray whether it
// missed or was totally reflected; such a ray goes on as an axial one. In float32 all is float32; eager takes its roots
// in float64.
// Plain: textbook algebra from where the ray is, nothing checked; only the root is still the one that does not cancel.

#include <cmath>
#include <cstdint>
#include <vector>

namespace {

enum Kind { plane = 0, sphere = 1, asphere = 2 };
constexpr int most_terms = 8;

struct Surface {
    std::int32_t kind, bends, terms, reserved;
    double gap, curvature, shape, before, behind;  // mm, 1/mm, 1 + conic, refractive indices
    double coefficients[most_terms];               // of r², r⁴, …
};

template <class T> struct Mask;  // as wide as the number, so that both fill one vector
template <> struct Mask<float> { using type = std::int32_t; };
template <> struct Mask<double> { using type = std::int64_t; };

template <class T> struct Block {
    static constexpr int size = 2048 / sizeof(T);
    using Flag = typename Mask<T>::type;
    alignas(64) T x[size], y[size], z[size], L[size], M[size], N[size], t[size];
    alignas(64) Flag lost[size];  // 0: alive, 1: missed, 2: totally reflected
};

template <class T> constexpr T rounding = sizeof(T) == 4 ? T(1.1920929e-7) : T(2.220446049250313e-16);
template <class T> constexpr bool polishes = sizeof(T) == 8;

#define INLINE inline __attribute__((always_inline))
#define LOOP __attribute__((noinline)) void  // inlined into a longer function not all of them become vectors
#define RAYS _Pragma("GCC ivdep") for (int i = 0; i < Block<T>::size; i++)

// d' = (n1/n2) d + D/n2/(a ± b) n with D = (n2 - n1)(n2 + n1); whether light passes.
template <class T>
INLINE bool bend(T& L, T& M, T& N, T nx, T ny, T nz, T norm_squared, T cosine, T n1, T D, T ratio, T D_over_n2) {
    const T a = n1 * cosine, b_squared = a * a + D * norm_squared;
    const bool passes = b_squared > 0;
    const T b = std::sqrt(passes ? b_squared : T(1));
    const T along = D_over_n2 / (a + std::copysign(b, a));
    L = ratio * L + along * nx;
    M = ratio * M + along * ny;
    N = ratio * N + along * nz;
    const T factor = T(1.5) - T(0.5) * (L * L + M * M + N * N);
    L *= factor;
    M *= factor;
    N *= factor;
    return passes;
}

template <class T> struct Indices {
    T n1, D, ratio, D_over_n2;
    explicit Indices(const Surface& s)
        : n1(T(s.before)), D((T(s.behind) - n1) * (T(s.behind) + n1)), ratio(n1 / T(s.behind)), D_over_n2(D / T(s.behind)) {}
};

template <class T>
INLINE void leave(Block<T>& b, int i, T x, T y, T z, T L, T M, T N, bool met, bool passes) {
    const typename Block<T>::Flag reason = met ? (passes ? 0 : 2) : 1;
    const bool alive = reason == 0;
    b.x[i] = alive ? x : T(0);
    b.y[i] = alive ? y : T(0);
    b.z[i] = alive ? z : T(0);
    b.L[i] = alive ? L : T(0);
    b.M[i] = alive ? M : T(0);
    b.N[i] = alive ? N : T(1);
    b.lost[i] = b.lost[i] != 0 ? b.lost[i] : reason;
}

template <class T, bool bends> LOOP cross_plane(Block<T>& b, const Surface& s) {
    const Indices<T> n(s);
    const T gap = T(s.gap);
    RAYS {
        T L = b.L[i], M = b.M[i], N = b.N[i];
        const T reach = (b.z[i] - gap) / N;
        const bool met = reach * reach < T(INFINITY);  // a ray along the plane, or one that meets it beyond all numbers
        const T t = met ? reach : T(0);
        N = met ? N : T(1);
        const T x = b.x[i] - t * L, y = b.y[i] - t * M;
        bool passes = true;
        if (bends) passes = bend(L, M, N, T(0), T(0), T(1), T(1), N, n.n1, n.D, n.ratio, n.D_over_n2);
        leave(b, i, x, y, T(0), L, M, N, met, passes);
    }
}

template <class T, bool bends> LOOP cross_sphere(Block<T>& b, const Surface& s) {
    const Indices<T> n(s);
    const T gap = T(s.gap), c = T(s.curvature);
    RAYS {
        T L = b.L[i], M = b.M[i], N = b.N[i];
        T x = b.x[i], y = b.y[i], z = b.z[i] - gap;
        const T slide = -(x * L + y * M + z * N);
        x += slide * L;
        y += slide * M;
        z += slide * N;
        const T F = c * (x * x + y * y + z * z) - 2 * z;
        const T discriminant = N * N - c * F;
        const T root = std::sqrt(discriminant > 0 ? discriminant : T(0));
        T t = F / (N + std::copysign(root, N));
        const T level = std::fabs(c * (z + t * N));
        const bool met = (discriminant > 0 ? level : T(1)) < 1;  // one comparison: two joined are not made vectors
        t = met ? t : T(0);
        N = met ? N : T(1);
        x = (met ? x : T(0)) + t * L;
        y = (met ? y : T(0)) + t * M;
        z = (met ? z : T(0)) + t * N;
        T dF = c * (x * L + y * M + z * N) - N;
        if (polishes<T>) {
            const T step = (T(0.5) * c * (x * x + y * y + z * z) - z) / dF;
            x -= step * L;
            y -= step * M;
            z -= step * N;
            dF -= c * step;
        }
        bool passes = true;
        if (bends) passes = bend(L, M, N, -c * x, -c * y, 1 - c * z, T(1), -dF, n.n1, n.D, n.ratio, n.D_over_n2);
        leave(b, i, x, y, z, L, M, N, met, passes);
    }
}

// Sag and dS/d(r²) at u = r² of a conic with even terms, and the size of the terms; the radicand is held above 0.
template <class T, int terms> struct Sag {
    T c, shape, a[terms], size[terms], first[terms];
    explicit Sag(const Surface& s) : c(T(s.curvature)), shape(T(s.shape)) {
        for (int j = 0; j < terms; j++) {
            a[j] = T(s.coefficients[j]);
            size[j] = std::fabs(a[j]);
            first[j] = a[j] * T(j + 1);
        }
    }
    INLINE T horner(const T* of, T u) const {
        T sum = of[terms - 1];
        for (int j = terms - 2; j >= 0; j--) sum = sum * u + of[j];
        return sum;
    }
    INLINE T radicand(T u) const { return 1 - shape * c * c * u; }
    INLINE void at(T u, T& S, T& dS) const {
        const T inside = radicand(u);
        const T w = std::sqrt(inside > 0 ? inside : T(1e-30));
        S = c * u / (1 + w) + u * horner(a, u);
        dS = T(0.5) * c / w + horner(first, u);
    }
};

// Newton's method from the base conic, the same number of steps for every ray; accepted by its residual in the end.
template <class T, int terms> LOOP cross_asphere(Block<T>& b, const Surface& s, int steps) {
    const Indices<T> n(s);
    const Sag<T, terms> sag(s);
    const T gap = T(s.gap), c = T(s.curvature), shape = T(s.shape);
    RAYS {
        const T L = b.L[i], M = b.M[i], N = b.N[i];
        T x = b.x[i], y = b.y[i], z = b.z[i] - gap;
        const T slide = -(x * L + y * M + z * N);
        b.x[i] = x += slide * L;
        b.y[i] = y += slide * M;
        b.z[i] = z += slide * N;
        const T A = c * (L * L + M * M + shape * N * N);
        const T G = N - c * (x * L + y * M + shape * z * N);
        const T F = c * (x * x + y * y + shape * z * z) - 2 * z;
        const T discriminant = G * G - A * F;
        const T root = std::copysign(std::sqrt(discriminant > 0 ? discriminant : T(0)), N);
        const bool usable = (discriminant > 0 ? G * N : T(0)) > 0;
        b.t[i] = (usable ? F : -z) / (usable ? G + root : N);
    }
    for (int step = 0; step < steps; step++) {
        RAYS {
            const T L = b.L[i], M = b.M[i], N = b.N[i], t = b.t[i];
            const T x = b.x[i] + t * L, y = b.y[i] + t * M, z = b.z[i] + t * N;
            T S, dS;
            sag.at(x * x + y * y, S, dS);
            const T dF = N - 2 * dS * (x * L + y * M);
            b.t[i] = t - (z - S) / (dF != 0 ? dF : T(1));
        }
    }
    RAYS {
        T L = b.L[i], M = b.M[i], N = b.N[i];
        const T t = b.t[i];
        T x = b.x[i] + t * L, y = b.y[i] + t * M, z = b.z[i] + t * N, S, dS;
        T u = x * x + y * y;
        sag.at(u, S, dS);
        const T radial = x * L + y * M;
        const T dF = N - 2 * dS * radial, F = z - S;
        const T terms_size = std::fabs(z) + std::fabs(c * u) + u * sag.horner(sag.size, u) + std::fabs(b.z[i]) +
                             std::fabs(t * N) + 2 * std::fabs(dS) * (u + std::fabs(radial * t));
        const T ahead = sag.radicand(u) > 0 ? dF * N : T(0);
        const bool met = (std::fabs(F) <= 64 * rounding<T> * terms_size ? ahead : T(0)) > 0;
        if (polishes<T>) {
            const T step = F / (met ? dF : T(1));
            x -= step * L;
            y -= step * M;
            z -= step * N;
            u = x * x + y * y;
            sag.at(u, S, dS);
        }
        const T slope = 2 * dS, cosine = N - slope * (x * L + y * M);
        const bool passes = bend(
            L, M, N, -slope * x, -slope * y, T(1), 1 + slope * slope * u, cosine, n.n1, n.D, n.ratio, n.D_over_n2);
        leave(b, i, x, y, z, L, M, N, met, passes);
    }
}

template <class T, bool curved, bool bends> LOOP cross_plainly(Block<T>& b, const Surface& s) {
    const T gap = T(s.gap), c = T(s.curvature), ratio = T(s.before) / T(s.behind);
    RAYS {
        const T L = b.L[i], M = b.M[i], N = b.N[i];
        T x = b.x[i], y = b.y[i], z = b.z[i] - gap, t, cosine;
        if (curved) {
            const T F = c * (x * x + y * y + z * z) - 2 * z;
            const T G = N - c * (x * L + y * M + z * N);
            cosine = std::sqrt(G * G - c * F);  // n·d where the ray meets the sphere
            t = F / (G + cosine);
        } else {
            t = -z / N;
            cosine = N;
        }
        b.x[i] = x += t * L;
        b.y[i] = y += t * M;
        b.z[i] = z += t * N;
        if (bends) {
            const T behind = std::sqrt(1 - ratio * ratio * (1 - cosine * cosine)), along = behind - ratio * cosine;
            b.L[i] = ratio * L - (curved ? along * c * x : T(0));
            b.M[i] = ratio * M - (curved ? along * c * y : T(0));
            b.N[i] = ratio * N + along * (curved ? 1 - c * z : T(1));
        }
    }
}

template <class T, int terms = most_terms> void choose_asphere(Block<T>& b, const Surface& s, int steps) {
    if constexpr (terms > 1)
        if (s.terms < terms) return choose_asphere<T, terms - 1>(b, s, steps);
    cross_asphere<T, terms>(b, s, steps);
}

template <class T> void cross(Block<T>& b, const Surface& s, int steps) {
    if (s.kind == plane) return s.bends ? cross_plane<T, true>(b, s) : cross_plane<T, false>(b, s);
    if (s.kind == sphere) return s.bends ? cross_sphere<T, true>(b, s) : cross_sphere<T, false>(b, s);
    choose_asphere(b, s, steps);
}

template <class T> void cross_plain(Block<T>& b, const Surface& s) {
    if (s.kind == plane) return s.bends ? cross_plainly<T, false, true>(b, s) : cross_plainly<T, false, false>(b, s);
    s.bends ? cross_plainly<T, true, true>(b, s) : cross_plainly<T, true, false>(b, s);
}

template <class T> struct Arrays {  // (3, count) each, and one byte a ray
    const T *position, *direction;
    const std::uint8_t* valid;
    T *to_position, *to_direction;
    std::uint8_t* to_valid;
    std::int64_t count;
};

template <class T> void load(Block<T>& b, const Arrays<T>& of, std::int64_t from, int filled) {
    T* into[] = {b.x, b.y, b.z, b.L, b.M, b.N};
    for (int k = 0; k < 6; k++) {
        const T* column = (k < 3 ? of.position : of.direction) + (k % 3) * of.count + from;
        for (int i = 0; i < filled; i++) into[k][i] = column[i];
        for (int i = filled; i < Block<T>::size; i++) into[k][i] = T(k == 5);
    }
    for (int i = 0; i < Block<T>::size; i++) b.lost[i] = 0;
}

template <class T> void store(const Block<T>& b, const Arrays<T>& of, std::int64_t from, int filled) {
    const T* out[] = {b.x, b.y, b.z, b.L, b.M, b.N};
    for (int k = 0; k < 6; k++) {
        T* column = (k < 3 ? of.to_position : of.to_direction) + (k % 3) * of.count + from;
        for (int i = 0; i < filled; i++) column[i] = out[k][i];
    }
    for (int i = 0; i < filled; i++) of.to_valid[from + i] = of.valid[from + i] & std::uint8_t(b.lost[i] == 0);
}

template <class T>
void trace_blocks(
    const std::vector<Surface>& surfaces, const Arrays<T>& rays, std::int64_t first, std::int64_t last, int steps,
    bool plain) {
    Block<T> block;
    for (std::int64_t from = first; from < last; from += Block<T>::size) {
        const int filled = int(last - from < Block<T>::size ? last - from : Block<T>::size);
        load(block, rays, from, filled);
        for (const Surface& surface : surfaces) plain ? cross_plain(block, surface) : cross(block, surface, steps);
        store(block, rays, from, filled);
    }
}

template <class T>
void trace(const Surface* surfaces, int number, const Arrays<T>& rays, int steps, bool plain, int threads) {
    const std::vector<Surface> copied(surfaces, surfaces + number);
    const std::int64_t blocks = (rays.count + Block<T>::size - 1) / Block<T>::size;
    const std::int64_t most = blocks / 8 + 1;  // waking a thread costs as much as some blocks
    const std::int64_t workers = threads < most ? threads : most;
    const std::int64_t share = (blocks + workers - 1) / workers * Block<T>::size;
#pragma omp parallel for schedule(static, 1) num_threads(int(workers)) if (workers > 1)
    for (std::int64_t k = 0; k < workers; k++) {
        const std::int64_t last = (k + 1) * share < rays.count ? (k + 1) * share : rays.count;
        trace_blocks(copied, rays, k * share, last, steps, plain);
    }
}

}  // namespace

#define ENTRY(name, T)                                                                                               \
    extern "C" void name(                                                                                            \
        const Surface* surfaces, int number, const T* position, const T* direction, const std::uint8_t* valid,       \
        T* to_position, T* to_direction, std::uint8_t* to_valid, std::int64_t count, int steps, int plain,           \
        int threads) {                                                                                               \
        trace<T>(surfaces, number, {position, direction, valid, to_position, to_direction, to_valid, count}, steps,  \
                 plain != 0, threads);                                                                               \
    }

ENTRY(trace_float32, float)
ENTRY(trace_float64, double)
