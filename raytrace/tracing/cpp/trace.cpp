// Rays through all surfaces of a lens, block by block, and the adjoint of the whole.
//
// The adjoint stores nothing of a trace but its start: it traces a block again, keeps what happened at each surface in
// the cache, and goes back through it. Memory beside the results is O(surfaces × block) for each thread.
#include <algorithm>
#include <memory>
#include <vector>

#include "adjoint.h"
#include "apertures.h"
#include "careful.h"
#include "phase_slopes.h"
#include "tangent.h"
#include "turns.h"

namespace raytrace {

// All that a call hands over; `_Call` in run.py has the same members in the same order.
struct Call {
  const Layout* layout;
  int64_t surfaces, rows, rays, numbers;  // rays: of a row; numbers: of a row
  const void* table;                      // (rows, numbers), of the rays' type
  const double* constants;
  const void* in[7];        // x, y, z, L, M, N and the path or null; each (rows, rays)
  void* out[7];             // the same behind the last surface; null: not wanted
  const void* cotangent[7];  // derivatives by the rays behind the last surface; null: 0
  void* by_rays[7];          // derivatives by the rays before the first; null: not wanted
  double* by_numbers;        // (rows, numbers), added to
  const uint8_t* valid_in;
  uint8_t* valid_out;
  int64_t changes;    // forward derivatives that are asked for at once
  const void* change;  // (changes, rows, numbers), of the rays' type
  void* changed[7];    // (changes, rows, rays) each: how the rays behind the last surface change; null: not wanted
  const void* at_start[7];  // (changes, rows, rays) each: how the rays before the first change; null: not at all
  int64_t everywhere;  // 1: `out`, `valid_out` and `changed` of forward derivatives have all surfaces as a first axis
};

template <typename T>
using Crosses = int (*)(const Rays<T>&, Rays<T>&, Notes<T>&, int, const Surface<T>&);
template <typename T>
using Pushes = void (*)(const Rays<T>&, const Rays<T>&, Rays<T>&, Notes<T>&, int, const Surface<T>&, const Change<T>&);
template <typename T>
using Pulls = Sums<T> (*)(const Rays<T>&, const Rays<T>&, Cotangents<T>&, Notes<T>&, int, const Surface<T>&);
template <typename T>
using Stands = void (*)(const Rays<T>&, Notes<T>&, int, const Surface<T>&);

// The functions for one kind of surface. Where it has a phase, `crosses` carries rays to it, and phases.h does the rest.
template <typename T, int kind, int bend, bool path, int terms>
struct Of {
  static constexpr int law = bend == kPhase ? kNone : bend;
  static Crosses<T> crosses() {
    if constexpr (kind == kPlane) return cross_plane<T, law, path>;
    else if constexpr (is_searched(kind)) return cross_asphere<T, kind, law, path, terms>;
    else return cross_conic<T, law, path, kind == kConic>;
  }
  static Pulls<T> pulls() { return pull<T, kind, bend, path, terms>; }
  static Pushes<T> pushes() { return push<T, kind, bend, path, terms>; }
  static Stands<T> stands() { return normals<T, kind, terms>; }
};

// Those of a turn.
template <typename T, bool path>
struct OfTurn {
  static Crosses<T> crosses() { return turn<T, path>; }
  static Pulls<T> pulls() { return pull_turn<T, path>; }
  static Pushes<T> pushes() { return push_turn<T, path>; }
  static Stands<T> stands() { return nullptr; }
};

// Calls work(Of<…>{}) for the kind of a surface, its effect on rays, and whether the path is needed.
template <typename T, int bend, bool path, typename Work>
void by_kind(const Layout& at, Work work) {
  if (at.kind == kPlane) work(Of<T, kPlane, bend, path, 0>{});
  else if (at.kind == kSphere) work(Of<T, kSphere, bend, path, 0>{});
  else if (at.kind == kConic) work(Of<T, kConic, bend, path, 0>{});
  else by_kind_of_terms(at, [&work](auto kind, auto terms) { work(Of<T, kind(), bend, path, terms()>{}); });
}

template <typename T, bool path, typename Work>
void by_bend(const Layout& at, Work work) {
  if (at.kind == kTurn) work(OfTurn<T, path>{});
  else if (at.phase != kNoPhase) by_kind<T, kPhase, path>(at, work);
  else if (at.bend == kNone) by_kind<T, kNone, path>(at, work);
  else if (at.bend == kRefract) by_kind<T, kRefract, path>(at, work);
  else by_kind<T, kReflect, path>(at, work);
}

template <typename T>
struct Step {
  Surface<T> surface;
  Crosses<T> crosses, silently;  // with the path as asked, and without
  Pulls<T> pulls;
  Pushes<T> pushes;
  Stands<T> stands;
};

template <typename T>
class Trace {
 public:
  explicit Trace(const Call& call) : call_(call), steps_(call.surfaces), path_(call.in[6] != nullptr) {}

  void forward(int64_t first, int64_t last) {
    auto rays = std::make_unique<Rays<T>[]>(2);
    auto notes = std::make_unique<Notes<T>>();
    each(first, last, [&](int64_t at, int count, int n) {
      load(rays[0], *notes, at, count, n, path_);
      int turn = 0;
      for (size_t k = 0; k < steps_.size(); k++, turn = 1 - turn) cross(k, rays[turn], rays[1 - turn], *notes, n, path_);
      store(call_.out, rays[turn], at, count);
      if (call_.valid_out) std::memcpy(call_.valid_out + at, notes->valid, count);
    });
  }

  void backward(int64_t first, int64_t last, double* by_numbers) {
    auto rays = std::make_unique<Rays<T>[]>(steps_.size() + 1);
    auto notes = std::make_unique<Notes<T>>();
    auto g = std::make_unique<Cotangents<T>>();
    each(first, last, [&](int64_t at, int count, int n) {
      load(rays[0], *notes, at, count, n, false);
      for (size_t k = 0; k < steps_.size(); k++) cross(k, rays[k], rays[k + 1], *notes, n, false);
      pick(*g, at, count, n);
      double* row = by_numbers + at / call_.rays * call_.numbers;
      for (size_t k = steps_.size(); k-- > 0;) {
        const Step<T>& step = steps_[k];
        forget(k, *g, rays.get(), *notes, n);
        if (step.surface.at->phase != kNoPhase) {
          stand(step, rays[k + 1], *notes, n);
          pull_phase(rays[k], rays[k + 1], *g, *notes, n, step.surface, row);
        }
        add(row, *step.surface.at, step.pulls(rays[k], rays[k + 1], *g, *notes, n, step.surface));
        if (has_sag_terms(step.surface.at->kind)) sum_sag_terms(*notes, n, step.surface, row);
      }
      store(call_.by_rays, *g, at, count);
    });
  }

  void tangents(int64_t first, int64_t last) {
    auto rays = std::make_unique<Rays<T>[]>(steps_.size() + 1);
    auto notes = std::make_unique<Notes<T>>();
    auto d = std::make_unique<Rays<T>>();
    const int64_t all = call_.rows * call_.rays;
    bool started = false;
    for (const void* part : call_.at_start) started |= part != nullptr;
    each(first, last, [&](int64_t at, int count, int n) {
      load(rays[0], *notes, at, count, n, path_);
      for (size_t k = 0; k < steps_.size(); k++) {
        cross(k, rays[k], rays[k + 1], *notes, n, path_);
        if (!is_told(k)) continue;
        store(call_.out, rays[k + 1], page(k) * all + at, count);
        if (call_.valid_out) std::memcpy(call_.valid_out + page(k) * all + at, notes->valid, count);
      }
      for (int64_t number = 0; number < call_.changes; number++) {
        set_off(*d, number * all + at, count, n);
        push_all(number, at, rays.get(), *d, *notes, count, n, started);
      }
    });
  }

 private:
  // How the rays before the first surface change.
  void set_off(Rays<T>& d, int64_t at, int count, int n) {
    for (int p = 0; p < 7; p++) {
      const T* given = static_cast<const T*>(call_.at_start[p]);
      if (given) std::memcpy(part(d, p), given + at, count * sizeof(T));
      const int from = given ? count : 0;
      std::memset(part(d, p) + from, 0, (n - from) * sizeof(T));
    }
  }

  // Whether the rays behind a surface are asked for, and which page of the results they are.
  bool is_told(size_t k) const { return call_.everywhere || k + 1 == steps_.size(); }
  int64_t page(size_t k) const { return call_.everywhere ? int64_t(k) : 0; }

  // One change, from the first surface that it touches on, or from the rays before the first if they change
  // (`begun`), to the results. A ray lost at a surface starts anew behind it.
  void push_all(int64_t number, int64_t at, const Rays<T>* rays, Rays<T>& d, Notes<T>& notes, int count, int n,
                bool begun) {
    const int64_t row = at / call_.rays, all = call_.rows * call_.rays;
    const T* changes = static_cast<const T*>(call_.change) + (number * call_.rows + row) * call_.numbers;
    for (size_t k = 0; k < steps_.size(); k++) {
      const Surface<T>& s = steps_[k].surface;
      const Change<T> change = change_of(*s.at, changes);
      begun |= change.any;
      if (begun) steps_[k].pushes(rays[k], rays[k + 1], d, notes, n, s, change);
      if (begun && s.at->phase != kNoPhase) {
        stand(steps_[k], rays[k + 1], notes, n);
        push_phase(rays[k], rays[k + 1], d, notes, n, s, change, path_);
      }
      for (int i = 0; i < n && notes.any_lost; i++)
        if (notes.lost[i] == int32_t(k))
          for (int p = 0; p < 7; p++) part(d, p)[i] = 0;
      if (is_told(k)) store(call_.changed, d, (page(k) * call_.changes + number) * all + at, count);
    }
  }

  // Calls work(first ray, rays, rays filled up to whole vectors) for the blocks `first` to `last`.
  template <typename Work>
  void each(int64_t first, int64_t last, Work work) {
    const int64_t blocks = (call_.rays + kBlock - 1) / kBlock;
    int64_t prepared = -1;
    for (int64_t block = first; block < last; block++) {
      int64_t row = block / blocks, begin = block % blocks * kBlock;
      if (row != prepared) prepare(row);
      prepared = row;
      int count = int(std::min<int64_t>(kBlock, call_.rays - begin));
      work(row * call_.rays + begin, count, (count + kVector - 1) / kVector * kVector);
    }
  }

  void prepare(int64_t row) {
    const T* numbers = static_cast<const T*>(call_.table) + row * call_.numbers;
    for (int64_t k = 0; k < call_.surfaces; k++) {
      const Layout& at = call_.layout[k];
      Step<T>& step = steps_[k];
      step.surface = surface_of(at, numbers, call_.constants);
      auto all = [&step](auto of) {
        step.crosses = of.crosses(), step.pulls = of.pulls(), step.pushes = of.pushes(), step.stands = of.stands();
      };
      by_bend<T, false>(at, [&step](auto of) { step.silently = of.crosses(); });
      path_ ? by_bend<T, true>(at, all) : by_bend<T, false>(at, all);
    }
  }

  static void set_axial(Rays<T>& rays, int i) {
    rays.x[i] = rays.y[i] = rays.z[i] = rays.L[i] = rays.M[i] = 0;
    rays.N[i] = 1;
  }

  static T* part(Rays<T>& rays, int number) {
    T* const parts[] = {rays.x, rays.y, rays.z, rays.L, rays.M, rays.N, rays.path};
    return parts[number];
  }

  void load(Rays<T>& rays, Notes<T>& notes, int64_t at, int count, int n, bool path) {
    for (int p = 0; p < 6 + path; p++)
      std::memcpy(part(rays, p), static_cast<const T*>(call_.in[p]) + at, count * sizeof(T));
    if (call_.valid_in) std::memcpy(notes.valid, call_.valid_in + at, count);
    for (int i = 0; i < n; i++) notes.lost[i] = -1;
    notes.any_lost = false;
    for (int i = count; i < n; i++) set_axial(rays, i), rays.path[i] = 0, notes.valid[i] = 0;
  }

  void store(void* const* to, Rays<T>& rays, int64_t at, int count) {
    for (int p = 0; p < 7; p++)
      if (to[p]) std::memcpy(static_cast<T*>(to[p]) + at, part(rays, p), count * sizeof(T));
  }

  void cross(size_t k, const Rays<T>& from, Rays<T>& to, Notes<T>& notes, int n, bool path) {
    const Step<T>& step = steps_[k];
    const Surface<T>& s = step.surface;
    notes.surface = int32_t(k);
    int flagged = (path ? step.crosses : step.silently)(from, to, notes, n, s);
    if (s.at->phase != kNoPhase) {
      stand(step, to, notes, n);
      flagged = through_phase(to, notes, n, s, path);
    }
    if (flagged)
      for (int i = 0; i < n; i++) {
        if (notes.flagged[i] == 0) continue;
        if (path) cross_carefully<T, true>(from, to, notes, i, s);
        else cross_carefully<T, false>(from, to, notes, i, s);
      }
    clip(to, notes.valid, n, call_.constants + s.at->first_aperture, s.at->apertures);
  }

  // The normals that a phase turns light about: of the surface, or of facets on it.
  static void stand(const Step<T>& step, const Rays<T>& at, Notes<T>& notes, int n) {
    if (step.surface.at->phase == kFacets) facet_normals(at, notes.normal, n, step.surface);
    else step.stands(at, notes, n, step.surface);
  }

  void pick(Cotangents<T>& g, int64_t at, int count, int n) {
    for (int p = 0; p < 7; p++) {
      T* to = part(g, p);
      const T* given = static_cast<const T*>(call_.cotangent[p]);
      if (given) std::memcpy(to, given + at, count * sizeof(T));
      int from = given ? count : 0;
      std::memset(to + from, 0, (n - from) * sizeof(T));
    }
  }

  // A ray lost at surface k starts anew behind it, whatever it was before: nothing passes back. Up to there it is put
  // on an axial course, on which everything is finite.
  static void forget(size_t k, Cotangents<T>& g, Rays<T>* rays, const Notes<T>& notes, int n) {
    for (int i = 0; i < n && notes.any_lost; i++) {
      if (notes.lost[i] != int32_t(k)) continue;
      for (int p = 0; p < 7; p++) part(g, p)[i] = 0;
      for (size_t before = 0; before <= k + 1; before++) set_axial(rays[before], i);
    }
  }

  static void add(double* row, const Layout& at, const Sums<T>& sums) {
    auto put = [row](int32_t offset, T value) { if (offset >= 0) row[offset] += value; };
    put(at.gap, sums.gap), put(at.curvature, sums.c), put(at.conic, sums.k);
    put(at.before, sums.n1), put(at.behind, sums.n2);
    for (int j = 0; j < at.terms; j++) row[at.coefficients + j] += sums.a[j];
  }

  const Call& call_;
  std::vector<Step<T>> steps_;
  bool path_;
};

// A trace is cut into pieces of so many blocks, which threads take as they come. What a piece is does not depend on the
// number of threads, and sums of pieces are added in their order: so results do not depend on it either.
constexpr int64_t kPiece = 64;

inline int64_t blocks_of(const Call& call) { return call.rows * ((call.rays + kBlock - 1) / kBlock); }

template <typename T, typename Work>
void in_pieces(const Call& call, int threads, Work work) {
  const int64_t blocks = blocks_of(call), pieces = (blocks + kPiece - 1) / kPiece;
  (void)threads;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads) if (threads > 1)
  for (int64_t piece = 0; piece < pieces; piece++) {
    Trace<T> trace(call);
    work(trace, piece, piece * kPiece, std::min((piece + 1) * kPiece, blocks));
  }
}

template <typename T>
void forward(const Call& call, int threads) {
  in_pieces<T>(call, threads, [](Trace<T>& t, int64_t, int64_t first, int64_t last) { t.forward(first, last); });
}

template <typename T>
void tangents(const Call& call, int threads) {
  in_pieces<T>(call, threads, [](Trace<T>& t, int64_t, int64_t first, int64_t last) { t.tangents(first, last); });
}

template <typename T>
void backward(const Call& call, int threads) {
  const int64_t of_a_row = blocks_of(call) / call.rows, pieces = (blocks_of(call) + kPiece - 1) / kPiece;
  std::vector<std::vector<double>> sums(pieces);  // of each piece, over the rows that it touches
  in_pieces<T>(call, threads, [&](Trace<T>& t, int64_t piece, int64_t first, int64_t last) {
    int64_t row = first / of_a_row, rows = (last - 1) / of_a_row - row + 1;
    sums[piece].assign(rows * call.numbers, 0.0);
    t.backward(first, last, sums[piece].data() - row * call.numbers);
  });
  for (int64_t piece = 0; piece < pieces; piece++) {
    double* row = call.by_numbers + piece * kPiece / of_a_row * call.numbers;
    for (size_t i = 0; i < sums[piece].size(); i++) row[i] += sums[piece][i];
  }
}

}  // namespace raytrace

// One number type, RAYTRACE_REAL: the objects of float and of double are compiled side by side.
#define RAYTRACE_NAME(work, real) raytrace_##work##_##real
#define RAYTRACE_ENTRY(work, real) \
  void RAYTRACE_NAME(work, real)(const raytrace::Call* call, int threads) { raytrace::work<real>(*call, threads); }

extern "C" {
RAYTRACE_ENTRY(forward, RAYTRACE_REAL)
RAYTRACE_ENTRY(tangents, RAYTRACE_REAL)
RAYTRACE_ENTRY(backward, RAYTRACE_REAL)
}
