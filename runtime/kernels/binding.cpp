// The Python module `runtime.kernels.compiled` (compiled.pyi). It checks every array's type, shape and strides, keeps it
// alive while it is used, and lets other Python threads run during calls.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "loops.hpp"
#include "panels.hpp"
#include "solver.hpp"

namespace nb = nanobind;
using namespace nb::literals;

int processor_level = 1;

namespace {

constexpr int INTERFACE = 2;  // also in __init__.py; raised by every change that older Python code cannot call

template <typename T> using Array = nb::ndarray<T, nb::device::cpu, nb::c_contig>;
template <typename T> using Strided = nb::ndarray<T, nb::device::cpu>;

template <typename AnyArray>
int size_of(const AnyArray &array, size_t axis) {
  require(array.shape(axis) <= size_t(MAX_SIDE) * 64, "an array is too large");
  return int(array.shape(axis));
}

template <typename AnyArray>
void require_shape(const AnyArray &array, std::initializer_list<int64_t> shape, const char *message) {
  require(array.ndim() == shape.size(), message);
  size_t axis = 0;
  for (const int64_t size : shape) require(size < 0 || int64_t(array.shape(axis)) == size, message), ++axis;  // -1: any
}

// Return the number of channels of a (rows, columns[, channels]) array whose pixels follow each other in a row.
template <typename AnyArray>
int channels_of(const AnyArray &array, const char *message) {
  require(array.ndim() == 2 || array.ndim() == 3, message);
  const int channels = array.ndim() == 3 ? size_of(array, 2) : 1;
  require(array.shape(0) >= 1 && array.shape(1) >= 1 && channels >= 1, message);
  require(array.ndim() == 2 || array.stride(2) == 1, message);
  require(array.stride(1) == channels || array.shape(1) == 1, message);
  return channels;
}

template <typename T>
std::vector<T> copied(const Array<const T> &array) { return {array.data(), array.data() + array.size()}; }

std::shared_ptr<Rays> rays_of(const std::vector<Strided<const uint8_t>> &pictures, const Array<const int16_t> &column_taper, const Array<const int16_t> &row_taper, const Array<const int32_t> &table, float rest, float missing) {
  constexpr const char *message = "pictures must have the same (rows, columns) or (rows, columns, 3), and contiguous rows";
  require(!pictures.empty(), message);
  auto rays = std::make_shared<Rays>();
  rays->channels = channels_of(pictures[0], message);
  rays->rows = size_of(pictures[0], 0), rays->width = size_of(pictures[0], 1);
  require(rays->rows <= MAX_SIDE && rays->width <= MAX_SIDE, "a picture is too large");
  const int64_t bytes = int64_t(rays->width) * rays->channels;
  for (const auto &picture : pictures) {
    require(channels_of(picture, message) == rays->channels && size_of(picture, 0) == rays->rows && size_of(picture, 1) == rays->width, message);
    require(picture.stride(0) >= bytes || rays->rows == 1, message);
    rays->targets.emplace_back(picture.data(), picture.stride(0), bytes, rays->rows);
  }
  require_shape(column_taper, {rays->width}, "there must be one taper weight for each column");
  require_shape(row_taper, {rays->rows}, "there must be one taper weight for each row");
  require_shape(table, {256}, "the table must have an entry for each code");
  rays->column_taper.reserve(size_t(bytes + 2 * LANES));
  for (int u = 0; u < rays->width; ++u) rays->column_taper.insert(rays->column_taper.end(), rays->channels, column_taper.data()[u]);
  rays->column_taper.resize(size_t(bytes + 2 * LANES));
  rays->row_taper = copied(row_taper);
  std::copy(table.data(), table.data() + 256, rays->table.begin());
  rays->rest = rest, rays->missing = missing;
  return rays;
}

// `Rays` with the pictures that it reads.
struct HeldRays {
  std::vector<Strided<const uint8_t>> pictures;
  std::shared_ptr<const Rays> rays;

  HeldRays(std::vector<Strided<const uint8_t>> given, const Array<const int16_t> &column_taper, const Array<const int16_t> &row_taper, const Array<const int32_t> &table, float rest, float missing)
      : pictures(std::move(given)), rays(rays_of(pictures, column_taper, row_taper, table, rest, missing)) {}
};

void require_panel(const Panels &panels, int n, int rows, int columns) {
  require(n >= 0 && n < panels.count, "there is no such panel");
  require(rows >= 0 && columns >= 0 && rows <= panels.rows && columns <= panels.columns, "a box is larger than its panel");
}

void set_panel(Panels &panels, int n, const Array<const int16_t> &values) {
  constexpr const char *message = "a panel's values must be (rows, columns), or (rows, columns, 3) if three channels are solved";
  require(channels_of(values, message) == panels.channels, message);
  const int rows = size_of(values, 0);
  const int64_t elements = int64_t(size_of(values, 1)) * panels.channels;
  require_panel(panels, n, rows, size_of(values, 1));
  for (int r = 0; r < rows; ++r) std::memcpy(panels.row(panels.last, n, r), values.data() + r * elements, size_t(elements) * sizeof(int16_t));
}

void fill_panel(Panels &panels, int n, int rows, int columns, int value) {
  require_panel(panels, n, rows, columns);
  for (int r = 0; r < rows; ++r) std::fill_n(panels.row(panels.last, n, r), int64_t(columns) * panels.channels, int16_t(value));
}

nb::ndarray<nb::numpy, int16_t, nb::ndim<3>> panel_values(const Panels &panels, int n, int rows, int columns) {
  require_panel(panels, n, rows, columns);
  const int64_t elements = int64_t(columns) * panels.channels;
  auto *values = new int16_t[size_t(rows * elements)];
  nb::capsule owner(values, [](void *memory) noexcept { delete[] static_cast<int16_t *>(memory); });
  for (int r = 0; r < rows; ++r) std::memcpy(values + r * elements, panels.row(panels.last, n, r), size_t(elements) * sizeof(int16_t));
  return {values, {size_t(rows), size_t(columns), size_t(panels.channels)}, owner};
}

void write_panel(const Panels &panels, int n, int row, int column, Strided<uint8_t> &pixels, int begin, int end) {
  constexpr const char *message = "pixels must be (rows, columns, 4)";
  require(pixels.ndim() == 3 && channels_of(pixels, message) == 4 && pixels.stride(0) % 4 == 0, message);
  const int rows = size_of(pixels, 0), columns = size_of(pixels, 1);
  require(row >= 0 && column >= 0 && row <= MAX_SIDE && column <= MAX_SIDE, "there is no such pixel");
  require_panel(panels, n, row + rows, column + columns);
  require(0 <= begin && begin <= end && end <= rows, "there are no such rows");
  uint8_t *to = pixels.data();
  const int64_t stride = pixels.stride(0);
  nb::gil_scoped_release others_run;
  for (int r = begin; r < end; ++r)
    show(panels.row(panels.last, n, row + r) + int64_t(column) * panels.channels, panels.channels, reinterpret_cast<uint32_t *>(to + r * stride), columns);
}

void require_part(int part, int parts) { require(0 <= part && part < parts, "there is no such part"); }

std::vector<RaySet> ray_sets_of(const std::vector<std::pair<int, int>> &sets) {
  std::vector<RaySet> ray_sets;
  for (const auto &[view, turn] : sets) ray_sets.push_back({view, turn});
  return ray_sets;
}

struct HeldProblem {
  Problem problem;

  HeldProblem(const Panels &panels, const HeldRays &rays, bool closing, std::vector<Size> boxes, const Array<const double> &panels_from_rays, const Array<const double> &rays_from_panels, const std::vector<std::pair<int, int>> &sets, int turns, std::vector<bool> grey)
      : problem(panels, closing, rays.rays, std::move(boxes), copied(panels_from_rays), copied(rays_from_panels), ray_sets_of(sets), turns, std::move(grey)) {
    for (const auto *matrices : {&panels_from_rays, &rays_from_panels})
      require_shape(*matrices, {problem.sets, problem.panels, 3, 3}, "homographies must be (sets, panels, 3, 3)");
  }
};

void warp_source(const Source &source, Array<int16_t> &result, const Array<const double> &image_from_raster, std::pair<double, double> image_law, std::pair<double, double> raster_law, double reach_px, int outside, std::pair<int, int> rows) {
  require(channels_of(result, "the result must be (rows, columns[, channels])") == source.channels, "the result must have as many channels as the image");
  require_shape(image_from_raster, {3, 3}, "a homography must be (3, 3)");
  require(std::abs(outside) <= 32767, "a pixel's value must fit in 16 bits");
  Warp by{{}, {image_law.first, image_law.second}, {raster_law.first, raster_law.second}, reach_px};
  std::copy(image_from_raster.data(), image_from_raster.data() + 9, by.image_from_raster);
  const int height = size_of(result, 0), width = size_of(result, 1);
  const Image image{result.data(), int64_t(width) * source.channels, height, width, height};
  nb::gil_scoped_release others_run;
  source.warp(image, by, outside, rows.first, rows.second);
}

std::pair<double, int64_t> light_error(const Array<const uint8_t> &layers, const Array<const float> &target, const Array<const double> &centre_from_image, const Array<const double> &panels_from_centre, const Array<const double> &toward, const Array<const float> &table, std::pair<int64_t, int> first_ray_and_rays, int step, std::pair<int, int> rows) {
  const auto [first_ray, rays] = first_ray_and_rays;
  require(layers.ndim() == 4 && layers.shape(1) >= 1 && layers.shape(2) >= 1 && layers.shape(3) >= 3, "layers must be (panels, rows, columns, 3 or 4)");
  const int panels = size_of(layers, 0), points = size_of(panels_from_centre, 0);
  require_shape(target, {-1, -1, 3}, "the target must be (rows, columns, 3)");
  require_shape(centre_from_image, {3, 3}, "a homography must be (3, 3)");
  require_shape(panels_from_centre, {-1, panels, 3, 3}, "homographies must be (points, panels, 3, 3)");
  require_shape(toward, {3}, "the direction must be (3,)");
  require(rays >= 0 && rays <= 1024 && step >= 1 && points >= 1 && points <= 65536, "the sampling is out of range");
  const int64_t sums = int64_t(255) * panels * (rays ? 1 : TABLE_STEPS) + 1;
  require(table.ndim() == 1 && int64_t(table.shape(0)) >= sums, "the table must have an entry for each sum of codes");
  View view{layers.data(), panels, size_of(layers, 1), size_of(layers, 2), size_of(layers, 3),
            target.data(), size_of(target, 0), size_of(target, 1), centre_from_image.data(), panels_from_centre.data(),
            toward.data(), table.data(), first_ray, points, rays, step};
  require(0 <= rows.first && rows.first <= rows.second && rows.second <= view.rows, "there are no such rows");
  nb::gil_scoped_release others_run;
  const ErrorSum sum = squared_error(view, rows.first, rows.second);
  return {sum.total, sum.counted};
}

bool all_within(const Array<const int32_t> &numbers, int least, int count) {
  return std::all_of(numbers.data(), numbers.data() + numbers.size(), [&](int32_t n) { return n >= least && n < count; });
}

// `OutlinedPart` with the arrays that it reads.
struct HeldPart {
  Array<const float> vertices;
  Array<const int32_t> faces, ends, apex;
  Array<const double> normals, heights;
  OutlinedPart part;

  HeldPart(Array<const float> of_vertices, Array<const int32_t> of_faces, Array<const int32_t> of_ends, Array<const int32_t> of_apex, Array<const double> of_normals, Array<const double> of_heights)
      : vertices(std::move(of_vertices)), faces(std::move(of_faces)), ends(std::move(of_ends)), apex(std::move(of_apex)),
        normals(std::move(of_normals)), heights(std::move(of_heights)) {
    constexpr const char *message = "a part must have vertices (v, 12), faces (e, 2), ends (e, 2, 2), apex (e, 2), normals (t, 3) and heights (t,)";
    require_shape(vertices, {-1, VERTEX}, message), require_shape(faces, {-1, 2}, message);
    const int edges = size_of(faces, 0), triangles = size_of(heights, 0), count = size_of(vertices, 0);
    require_shape(ends, {edges, 2, 2}, message), require_shape(apex, {edges, 2}, message);
    require_shape(heights, {triangles}, message), require_shape(normals, {triangles, 3}, message);
    require(all_within(faces, -1, triangles) && all_within(ends, 0, count) && all_within(apex, 0, count), "a part's edges name faces or vertices that it does not have");
    for (int e = 0; e < edges; ++e) require(faces.data()[2 * e] >= 0, "an edge has no face");
    part = {vertices.data(), faces.data(), ends.data(), apex.data(), normals.data(), heights.data(), edges, triangles};
  }
};

int write_ramps(const HeldPart &held, const Array<const double> &eye, const Array<const double> &clip_from_part, std::pair<int, int> size_px, double ramp_px, Array<float> &ramps, int first) {
  require_shape(eye, {3}, "an eye must be (3,)");
  require_shape(clip_from_part, {4, 4}, "a clip matrix must be (4, 4)");
  require_shape(ramps, {-1, 4, CORNER}, "ramps must be (n, 4, 14)");
  require(first >= 0 && int64_t(first) + held.part.edges <= int64_t(ramps.shape(0)), "there is no room for the ramps");
  float *to = ramps.data() + int64_t(first) * 4 * CORNER;
  nb::gil_scoped_release others_run;
  return outline_ramps(held.part, eye.data(), clip_from_part.data(), size_px.first, size_px.second, ramp_px, to);
}

typedef std::array<float, 4> Map;  // scales across and down, shifts across and down

ScaleShift scale_shift(const Map &map) {
  require(std::all_of(map.begin(), map.end(), [](float x) { return std::abs(x) < 1e9f; }), "a map is not finite");
  return {map[0], map[1], map[2], map[3]};
}

template <typename AnyArray>
void require_pixels(const AnyArray &picture, int64_t least_px) {
  constexpr const char *message = "a picture must be (rows, columns, 4) with contiguous rows";
  require(picture.ndim() == 3 && channels_of(picture, message) == 4, message);
  for (int axis = 0; axis < 2; ++axis) require(int64_t(picture.shape(axis)) >= least_px && picture.shape(axis) <= MAX_SIDE, "a picture's size is out of range");
  require(picture.stride(0) >= 0 && picture.stride(0) % 4 == 0 && uintptr_t(picture.data()) % 4 == 0, message);
}

// `Shown` with the arrays that it reads and writes.
struct HeldPicture {
  Strided<const uint8_t> source;
  Strided<uint8_t> screen;
  std::optional<Strided<const uint8_t>> flat;
  std::optional<Array<const uint32_t>> curve;
  std::optional<Array<const float>> relief;
  Shown shown{};

  HeldPicture(Strided<const uint8_t> of_source, Strided<uint8_t> of_screen, const Map &source_from_panel, std::optional<Array<const double>> panel_from_screen, Size panel_px, std::optional<Array<const float>> of_relief, const Map &relief_from_screen, const Map &push, std::optional<Strided<const uint8_t>> of_flat, float flatness, std::optional<Array<const uint32_t>> of_curve, int every)
      : source(std::move(of_source)), screen(std::move(of_screen)), flat(std::move(of_flat)), curve(std::move(of_curve)), relief(std::move(of_relief)) {
    require_pixels(source, 2), require_pixels(screen, 1);
    shown.source = source.data(), shown.source_stride = source.stride(0), shown.screen = screen.data(), shown.screen_stride = screen.stride(0);
    shown.source_rows = size_of(source, 0), shown.source_columns = size_of(source, 1), shown.rows = size_of(screen, 0), shown.columns = size_of(screen, 1);
    require(int64_t(shown.source_rows) * shown.source_stride <= INT32_MAX, "a picture is too large");  // offsets have 32 bits
    shown.source_from_panel = scale_shift(source_from_panel), shown.relief_from_screen = scale_shift(relief_from_screen), shown.push = scale_shift(push);
    require(0 <= flatness && flatness <= 1, "a flatness must be from 0 to 1");
    require(every == 1 || (every == 2 && !flat), "only pictures without a flat one can be sampled at every other pixel");
    shown.flatness = flatness, shown.every = every;
    if (flat) {
      require_pixels(*flat, 1);
      require(size_of(*flat, 0) == shown.rows && size_of(*flat, 1) == shown.columns, "a flat picture must have the screen's size");
      shown.flat = flat->data(), shown.flat_stride = flat->stride(0);
    }
    if (curve) require_shape(*curve, {3, CURVE}, "a curve must be (3, 1024)"), shown.curve = curve->data();
    if (relief) {
      require_shape(*relief, {-1, -1}, "a relief must be (rows, columns)");
      require(relief->size() >= 1, "a relief must have a pixel");
      shown.relief = relief->data(), shown.relief_rows = size_of(*relief, 0), shown.relief_columns = size_of(*relief, 1);
    }
    if ((shown.registered = panel_from_screen.has_value())) {
      require_shape(*panel_from_screen, {3, 3}, "a homography must be (3, 3)");
      require(usable(panel_from_screen->data(), 1), "a homography is not finite");
      std::copy(panel_from_screen->data(), panel_from_screen->data() + 9, shown.panel_from_screen);
      std::tie(shown.panel_rows, shown.panel_columns) = panel_px;
    }
  }
};

void draw_pictures(const std::vector<const HeldPicture *> &pictures, int threads) {
  std::vector<Shown> shown;
  for (const HeldPicture *picture : pictures) shown.push_back(picture->shown);
  nb::gil_scoped_release others_run;
  draw_panels(shown.data(), int(shown.size()), threads);
}

std::tuple<int, int, int, int> framed(const Strided<const uint8_t> &turned, Array<uint8_t> &picture, int border_px, int extended_px) {
  constexpr const char *message = "a turned picture must be (rows, columns, 4), and the framed one larger by the border";
  require(turned.ndim() == 3 && turned.shape(2) == 4 && turned.stride(2) == 1 && uintptr_t(turned.data()) % 4 == 0, message);
  for (int axis = 0; axis < 2; ++axis) require(turned.shape(axis) >= 1 && turned.stride(axis) % 4 == 0, message);
  require(border_px >= 0 && border_px <= MAX_SIDE && extended_px >= 0 && extended_px <= std::min(border_px, 1), "a border is out of range");
  const int rows = size_of(turned, 0), columns = size_of(turned, 1);
  require_pixels(picture, 1);
  require_shape(picture, {rows + 2 * border_px, columns + 2 * border_px, 4}, message);
  const auto [left, top, right, bottom] = frame_picture(turned.data(), turned.stride(0), turned.stride(1), rows, columns, picture.data(), border_px, extended_px);
  return {left, top, right, bottom};
}

std::vector<int> levels() {
#if EVERY_LEVEL
  std::vector<int> usable;
  if (__builtin_cpu_supports("x86-64-v4")) usable.push_back(4);
  if (__builtin_cpu_supports("x86-64-v3")) usable.push_back(3);
  usable.push_back(1);
  return usable;
#else
  return {1};
#endif
}

void use_level(int level) {
  const std::vector<int> usable = levels();
  require(std::find(usable.begin(), usable.end(), level) != usable.end(), "this processor or build does not have the level");
  processor_level = level;
}

}  // namespace

NB_MODULE(compiled, m) {
  nb::set_leak_warnings(false);  // PyTorch keeps modules, and what they hold, until the process has ended
  processor_level = levels().front();
  m.attr("INTERFACE") = INTERFACE;
  m.attr("MAX_PANELS") = MAX_PANELS, m.attr("MAX_SETS") = MAX_SETS;
  m.def("levels", &levels), m.def("use_level", &use_level, "level"_a);

  nb::class_<Panels>(m, "Panels")
      .def(nb::init<int, int, int, int>(), "count"_a, "rows"_a, "columns"_a, "channels"_a)
      .def("set", &set_panel, "panel"_a, "values"_a.noconvert())
      .def("fill", &fill_panel, "panel"_a, "rows"_a, "columns"_a, "value"_a)
      .def("values", &panel_values, "panel"_a, "rows"_a, "columns"_a)
      .def("start", [](Panels &panels) { panels.starts = true; })
      .def("advance", &Panels::advance)
      .def("write", &write_panel, "panel"_a, "row"_a, "column"_a, "pixels"_a.noconvert(), "begin"_a, "end"_a);

  nb::class_<HeldRays>(m, "Rays")
      .def(nb::init<std::vector<Strided<const uint8_t>>, const Array<const int16_t> &, const Array<const int16_t> &, const Array<const int32_t> &, float, float>(),
           "pictures"_a.noconvert(), "column_taper"_a.noconvert(), "row_taper"_a.noconvert(), "table"_a.noconvert(), "rest"_a, "missing"_a);

  nb::class_<HeldProblem>(m, "Problem")
      .def(nb::init<const Panels &, const HeldRays &, bool, std::vector<Size>, const Array<const double> &, const Array<const double> &, const std::vector<std::pair<int, int>> &, int, std::vector<bool>>(),
           "panels"_a, "rays"_a, "closing"_a, "boxes"_a, "panels_from_rays"_a.noconvert(), "rays_from_panels"_a.noconvert(), "sets"_a, "turns"_a, "grey"_a,
           nb::keep_alive<1, 2>(), nb::keep_alive<1, 3>())
      .def("close_middle", [](const HeldProblem &held, int part, int parts) {
             require_part(part, parts);
             nb::gil_scoped_release others_run;
             close_middle(held.problem, part, parts);
           }, "part"_a, "parts"_a)
      .def("step", [](const HeldProblem &held, float size, float momentum, float floor, int part, int parts) {
             require_part(part, parts);
             require(std::abs(size) < 1e6f && std::abs(momentum) < 1 && floor > 0 && floor < 1e6f, "a step's size, momentum or floor is out of range");
             nb::gil_scoped_release others_run;
             step(held.problem, {size, momentum, floor}, part, parts);
           }, "size"_a, "momentum"_a, "floor"_a, "part"_a, "parts"_a);

  nb::class_<Source>(m, "Source")
      .def(nb::new_([](const Array<const int16_t> &image) {
             const int channels = channels_of(image, "an image must be (rows, columns[, channels])");
             const int rows = size_of(image, 0), width = size_of(image, 1);
             nb::gil_scoped_release others_run;
             return new Source(image.data(), rows, width, channels);
           }), "image"_a.noconvert())
      .def("warp", &warp_source, "result"_a.noconvert(), "image_from_raster"_a.noconvert(), "image_law"_a, "raster_law"_a, "reach_px"_a, "outside"_a, "rows"_a);

  m.def("squared_error", &light_error, "layers"_a.noconvert(), "target"_a.noconvert(), "centre_from_image"_a.noconvert(), "panels_from_centre"_a.noconvert(),
        "toward"_a.noconvert(), "table"_a.noconvert(), "rays"_a, "step"_a, "rows"_a);

  nb::class_<HeldPicture>(m, "PanelPicture")
      .def(nb::init<Strided<const uint8_t>, Strided<uint8_t>, const Map &, std::optional<Array<const double>>, Size, std::optional<Array<const float>>, const Map &, const Map &, std::optional<Strided<const uint8_t>>, float, std::optional<Array<const uint32_t>>, int>(),
           "source"_a.noconvert(), "screen"_a.noconvert(), "source_from_panel"_a, "panel_from_screen"_a.noconvert().none(), "panel_px"_a, "relief"_a.noconvert().none(), "relief_from_screen"_a, "push"_a,
           "flat"_a.noconvert().none(), "flatness"_a, "curve"_a.noconvert().none(), "every"_a);
  m.def("draw_panels", &draw_pictures, "pictures"_a, "threads"_a);
  m.def("frame_picture", &framed, "turned"_a.noconvert(), "framed"_a.noconvert(), "border_px"_a, "extended_px"_a);

  nb::class_<HeldPart>(m, "OutlinedPart")
      .def(nb::init<Array<const float>, Array<const int32_t>, Array<const int32_t>, Array<const int32_t>, Array<const double>, Array<const double>>(),
           "vertices"_a.noconvert(), "faces"_a.noconvert(), "ends"_a.noconvert(), "apex"_a.noconvert(), "normals"_a.noconvert(), "heights"_a.noconvert())
      .def("ramps", &write_ramps, "eye"_a.noconvert(), "clip_from_part"_a.noconvert(), "size_px"_a, "ramp_px"_a, "ramps"_a.noconvert(), "first"_a);
}
