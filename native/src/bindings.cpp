// SPDX-License-Identifier: Apache-2.0
// The extension module gausslite.render._kernels. render/cpu.py checks all shapes and names the argument in its errors;
// the array types here are a second check. Work runs without the interpreter lock. render/cpu.py ensures that a
// rasterizer has one call at a time.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <string>

#include "core_clock.h"
#include "dispatch.h"
#include "rasterizer.h"

namespace nb = nanobind;

namespace {

using namespace gausslite;

using RowTable = nb::ndarray<float, nb::numpy, nb::shape<-1, 16>, nb::c_contig, nb::device::cpu>;
using ConstRowTable = nb::ndarray<const float, nb::numpy, nb::shape<-1, 16>, nb::c_contig, nb::device::cpu>;
using Matrix4 = nb::ndarray<const double, nb::numpy, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Plane = nb::ndarray<const float, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Colours = nb::ndarray<const float, nb::numpy, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using ByteColours = nb::ndarray<const uint8_t, nb::numpy, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using TileMask = nb::ndarray<const bool, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::numpy, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<uint32_t, nb::numpy, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Ids = nb::ndarray<const uint32_t, nb::numpy, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Intrinsics = std::tuple<double, double, double, double, int, int>;  // fx fy cx cy, width, height
// Linear velocity, angular velocity, readout and exposure time; of length 8.
using Motion = std::optional<std::vector<float>>;

void require(bool holds, const char* message) {
  if (!holds) throw nb::value_error(message);
}

template <class T, class... Sizes>
auto new_array(Sizes... sizes) {
  size_t total = 1;
  ((total *= size_t(sizes)), ...);
  T* data = new T[std::max<size_t>(total, 1)]();
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return nb::ndarray<nb::numpy, T>(data, {size_t(sizes)...}, owner);
}

Camera make_camera(const Intrinsics& intrinsics, const Matrix4& T_camera_world, const Motion& motion) {
  Camera camera;
  for (size_t i = 0; i < 3; ++i) {
    for (size_t j = 0; j < 3; ++j) camera.R_camera_world[3 * i + j] = float(T_camera_world(i, j));
    camera.t_camera_world[i] = float(T_camera_world(i, 3));
  }
  camera.fx = float(std::get<0>(intrinsics));
  camera.fy = float(std::get<1>(intrinsics));
  camera.cx = float(std::get<2>(intrinsics));
  camera.cy = float(std::get<3>(intrinsics));
  camera.width = std::get<4>(intrinsics);
  camera.height = std::get<5>(intrinsics);
  require(camera.width > 0 && camera.height > 0 && camera.width <= 16384 && camera.height <= 16384, "image size");
  if (motion) {
    require(motion->size() == 8, "motion: expected 8 values");
    const float* values = motion->data();
    camera.moves = true;
    std::copy_n(values, 3, camera.motion.linear_m_s);
    std::copy_n(values + 3, 3, camera.motion.angular_rad_s);
    camera.motion.readout_s = values[6];
    camera.motion.exposure_s = values[7];
  }
  return camera;
}

// Rows, camera, tiles and ids of a rendering.
struct Scene {
  FrameInput input;

  Scene(const float* rows, size_t count, const Intrinsics& intrinsics, const Matrix4& T_camera_world,
        const std::optional<TileMask>& tiles, const std::optional<Ids>& ids, const Motion& motion, float dilation_px2) {
    require(count < (size_t{1} << 31), "rows: too many");
    require(dilation_px2 > 0.0f && dilation_px2 < 1.0f, "dilation_px2: expected more than 0 and less than 1");
    input = {rows, uint32_t(count), nullptr, 0, nullptr, make_camera(intrinsics, T_camera_world, motion)};
    input.camera.dilation_px2 = dilation_px2;
    if (tiles) {
      const size_t tiles_x = size_t(input.camera.width + kTileSide - 1) / kTileSide,
                   tiles_y = size_t(input.camera.height + kTileSide - 1) / kTileSide;
      require(tiles->shape(0) == tiles_y && tiles->shape(1) == tiles_x, "tiles: wrong grid");
      input.active_tiles = reinterpret_cast<const uint8_t*>(tiles->data());
    }
    if (ids) {
      static constexpr uint32_t kNothing = 0;
      const uint32_t* first = ids->data();
      require(std::adjacent_find(first, first + ids->size(), std::greater_equal<>()) == first + ids->size() &&
                  (ids->size() == 0 || first[ids->size() - 1] < count),
              "ids");
      input.ids = ids->size() > 0 ? first : &kNothing;
      input.id_count = uint32_t(ids->size());
    }
  }
};

std::unique_ptr<Rasterizer> make_rasterizer(const std::string& simd, int threads) {
  const Stages* stages = find_stages(simd);
  require(stages != nullptr, "simd: not usable here");
  require(threads >= 1 && threads <= 256, "threads: expected 1 to 256");
  return std::make_unique<Rasterizer>(*stages, threads);
}

auto visible_ids(const Rasterizer& rasterizer) {
  auto ids = new_array<uint32_t>(rasterizer.visible_count());
  rasterizer.copy_visible(ids.data());
  return ids;
}

nb::tuple forward(Rasterizer& self, ConstRowTable rows, const Intrinsics& intrinsics, Matrix4 T_camera_world,
                  std::optional<TileMask> tiles, std::optional<Ids> ids, const Motion& motion, float dilation_px2) {
  const Scene scene(rows.data(), rows.shape(0), intrinsics, T_camera_world, tiles, ids, motion, dilation_px2);
  const size_t height = size_t(scene.input.camera.height), width = size_t(scene.input.camera.width);
  auto rgb = new_array<float>(height, width, 3);
  auto depth_m = new_array<float>(height, width);
  auto alpha = new_array<float>(height, width);
  const ImageOutput output{rgb.data(), depth_m.data(), alpha.data()};
  {
    nb::gil_scoped_release unlocked;
    self.forward(scene.input, output);
  }
  return nb::make_tuple(rgb, depth_m, alpha, self.frame());
}

nb::tuple backward(Rasterizer& self, uint64_t frame, size_t row_count, Colours d_rgb, Plane d_depth_m, Plane d_alpha) {
  require(frame == self.frame(), "rendering: superseded");
  require(self.matches(row_count, d_rgb.shape(1), d_rgb.shape(0)) && d_depth_m.shape(0) == d_rgb.shape(0) &&
              d_depth_m.shape(1) == d_rgb.shape(1) && d_alpha.shape(0) == d_rgb.shape(0) &&
              d_alpha.shape(1) == d_rgb.shape(1),
          "image gradients: wrong shape");
  auto d_rows = new_array<float>(row_count, 16);
  auto d_twist = new_array<double>(6);
  auto visible = visible_ids(self);
  auto norms = new_array<float>(visible.size());
  const ImageGradients input{d_rgb.data(), d_depth_m.data(), d_alpha.data()};
  {
    nb::gil_scoped_release unlocked;
    self.backward(input, d_rows.data(), d_twist.data(), norms.data());
  }
  return nb::make_tuple(d_rows, d_twist, visible, norms);
}

std::unique_ptr<TrainingView> make_view(ByteColours rgb, Plane depth_m, std::optional<Plane> pixel_weights) {
  const size_t height = rgb.shape(0), width = rgb.shape(1);
  const auto fits = [&](const Plane& plane) { return plane.shape(0) == height && plane.shape(1) == width; };
  require(fits(depth_m) && (!pixel_weights || fits(*pixel_weights)), "view: sizes disagree");
  nb::gil_scoped_release unlocked;
  return std::make_unique<TrainingView>(int(width), int(height), rgb.data(), depth_m.data(),
                                        pixel_weights ? pixel_weights->data() : nullptr);
}

// View, camera, tiles and ids of a step, converted once for repeated steps with the same arrays. It keeps the arrays
// alive; their values may change.
struct StepScene {
  const TrainingView& view;  // the binding keeps its owner alive
  Intrinsics intrinsics;
  Matrix4 T_camera_world;
  std::optional<TileMask> tiles;
  std::optional<Ids> ids;
  Motion motion;
  float dilation_px2;

  StepScene(const TrainingView& view, const Intrinsics& intrinsics, Matrix4 T_camera_world,
            std::optional<TileMask> tiles, std::optional<Ids> ids, const Motion& motion, float dilation_px2)
      : view(view),
        intrinsics(intrinsics),
        T_camera_world(T_camera_world),
        tiles(tiles),
        ids(ids),
        motion(motion),
        dilation_px2(dilation_px2) {}
};

// Tables, settings and masks of a step.
struct StepTraining {
  RowTable rows, first_moment, second_moment;
  LossWeights loss;
  AdamOptions adam;
  bool masked;
  std::optional<Counts> update_counts;
  std::optional<Flags> count_mask;
  uint64_t binding_id;

  StepTraining(std::tuple<RowTable, RowTable, RowTable> tables, std::tuple<float, float, float, bool> weights,
               const std::vector<float>& rates, std::tuple<double, double, double, double> constants, bool masked,
               std::optional<Counts> update_counts, std::optional<Flags> count_mask, uint64_t binding_id)
      : rows(std::get<0>(tables)),
        first_moment(std::get<1>(tables)),
        second_moment(std::get<2>(tables)),
        loss{std::get<0>(weights), std::get<1>(weights), std::get<2>(weights), std::get<3>(weights)},
        masked(masked),
        update_counts(update_counts),
        count_mask(count_mask),
        binding_id(binding_id) {
    const size_t n = rows.shape(0);
    require(first_moment.shape(0) == n && second_moment.shape(0) == n &&
                (!update_counts || update_counts->shape(0) == n) && (!count_mask || count_mask->shape(0) == n),
            "tables: lengths disagree");
    require(rates.size() == 16, "rates: expected 16");
    std::copy_n(rates.begin(), 16, adam.rates);
    std::tie(adam.beta1, adam.beta2, adam.epsilon, adam.decay_after_updates) = constants;
  }

  OptimizerState state() const {
    const auto flags = [](const std::optional<Flags>& of) {
      return of ? reinterpret_cast<const uint8_t*>(of->data()) : nullptr;
    };
    return {rows.data(),
            first_moment.data(),
            second_moment.data(),
            update_counts ? update_counts->data() : nullptr,
            flags(count_mask),
            binding_id};
  }
};

double step(Rasterizer& self, const StepScene& view_scene, const StepTraining& training) {
  const Scene scene(training.rows.data(), training.rows.shape(0), view_scene.intrinsics, view_scene.T_camera_world,
                    view_scene.tiles, view_scene.ids, view_scene.motion, view_scene.dilation_px2);
  const Camera& camera = scene.input.camera;
  require(view_scene.view.width() == camera.width && view_scene.view.height() == camera.height, "view: wrong size");
  const OptimizerState state = training.state();
  nb::gil_scoped_release unlocked;
  return self.step(scene.input, state, view_scene.view, training.masked, training.loss, training.adam);
}

nb::dict stage_times(const Rasterizer& self) {
  const StageTimes& t = self.times();
  nb::dict out;
  out["project"] = t.project;
  out["raster"] = t.render;  // the key in benchmark reports
  out["loss"] = t.loss;
  out["backward"] = t.backward;
  out["update"] = t.update;
  return out;
}

}  // namespace

NB_MODULE(_kernels, m) {
  m.doc() = "Native rasterizer kernels; use gausslite.render.cpu.CpuRasterizer.";
  m.def("usable_simd", &usable_variants,
        "Return the instruction sets of this build that this machine runs, fastest first.");
  m.def("core_clock_ghz", &core_clock_ghz, "Measure the clock of the current core in GHz.");

  nb::class_<TrainingView>(m, "View", "A training image in tiles, with its weights.")
      .def(nb::new_(&make_view), nb::arg("rgb").noconvert(), nb::arg("depth_m").noconvert(),
           nb::arg("pixel_weights").noconvert().none())
      .def_prop_ro("width", &TrainingView::width)
      .def_prop_ro("height", &TrainingView::height);

  nb::class_<StepScene>(m, "StepScene", "View, camera, tiles and ids of a step; references the arrays.")
      .def(nb::init<const TrainingView&, const Intrinsics&, Matrix4, std::optional<TileMask>, std::optional<Ids>,
                    const Motion&, float>(),
           nb::keep_alive<1, 2>(), nb::arg("view"), nb::arg("intrinsics"), nb::arg("T_camera_world").noconvert(),
           nb::arg("tiles").noconvert().none(), nb::arg("ids").noconvert().none(), nb::arg("motion").none(),
           nb::arg("dilation_px2"));

  nb::class_<StepTraining>(m, "StepTraining", "Tables, settings and counter of a step; references the arrays.")
      .def(nb::init<std::tuple<RowTable, RowTable, RowTable>, std::tuple<float, float, float, bool>,
                    const std::vector<float>&, std::tuple<double, double, double, double>, bool,
                    std::optional<Counts>, std::optional<Flags>, uint64_t>(),
           nb::arg("tables").noconvert(), nb::arg("loss"), nb::arg("rates"), nb::arg("adam"), nb::arg("masked"),
           nb::arg("update_counts").noconvert().none(),
           nb::arg("count_mask").noconvert().none(), nb::arg("binding_id"));

  nb::class_<Rasterizer>(m, "Engine", "Scratch memory and a thread pool; it does not own the splats.")
      .def(nb::new_(&make_rasterizer), nb::arg("simd"), nb::arg("threads"))
      .def_prop_ro("threads", &Rasterizer::threads)
      .def_prop_ro("frame", &Rasterizer::frame, "Number of the latest forward or step.")
      .def("forward", &forward, nb::arg("rows").noconvert(), nb::arg("intrinsics"),
           nb::arg("T_camera_world").noconvert(), nb::arg("tiles").noconvert().none(),
           nb::arg("ids").noconvert().none(), nb::arg("motion").none(), nb::arg("dilation_px2"),
           "Return rgb, depth_m, alpha and the frame number.")
      .def("backward", &backward, nb::arg("frame"), nb::arg("row_count"), nb::arg("d_rgb").noconvert(),
           nb::arg("d_depth_m").noconvert(), nb::arg("d_alpha").noconvert(),
           "Return d_rows, d_twist, visible rows and mean_2d_grad_norm.")
      .def("step", &step, nb::arg("scene"), nb::arg("training"), "Run one training iteration and return the loss.")
      .def("visible", &visible_ids, "Return the visible rows of the last forward or step, ascending.")
      .def_prop_ro("steps_ms", &Rasterizer::steps_ms, "Total milliseconds of all steps.")
      .def_prop_ro("masked_steps_ms", &Rasterizer::masked_steps_ms, "Total milliseconds of the masked steps.")
      .def("stage_times_ms", &stage_times, "Return the milliseconds of each stage of the last call.")
      .def_prop_ro("block_evaluations", &Rasterizer::block_evaluations,
                   "Number of pairs of a splat and a 4x4 pixel block that the last forward or step composited.");
}
