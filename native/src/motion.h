// SPDX-License-Identifier: Apache-2.0
// Rolling-shutter projection of 16 splats at once: the time at which the image row of a mean is exposed, and the mean
// at that time.
#pragma once

#include "camera.h"
#include "simd/pack.h"

namespace gausslite::GAUSSLITE_ISA {

// Velocity of static points p in the frame of a moving camera: -(v + w × p).
GAUSSLITE_INLINE void point_velocity(const CameraMotion& motion, const Pack16& x, const Pack16& y, const Pack16& z,
                                     Pack16 (&velocity)[3]) {
  const float *v = motion.linear_m_s, *w = motion.angular_rad_s;
  velocity[0] = fma(y, Pack16(w[2]), fnma(z, Pack16(w[1]), Pack16(-v[0])));
  velocity[1] = fma(z, Pack16(w[0]), fnma(x, Pack16(w[2]), Pack16(-v[1])));
  velocity[2] = fma(x, Pack16(w[1]), fnma(y, Pack16(w[0]), Pack16(-v[2])));
}

// Time at which the image row of each mean is exposed. To first order the mean crosses image rows at a constant speed
// s, from row y0 at the middle of the readout. It is recorded in row y = y0 + s·t, exposed at t = readout·(y / height -
// 1/2). So t = readout·(y0 / height - 1/2) / f, with the readout factor f = 1 - s·readout / height.
struct RowExposure {
  Pack16 velocity[3];     // of the mean in the camera frame, at the middle of the readout
  Pack16 tangent_y;       // y/z at that time
  Pack16 readout_factor;  // f, at least kMinReadoutFactor
  Pack16 time_per_row;    // derivative of t with respect to y0
  Pack16 unclamped_time;  // t; the backward pass compares it with `time`, because a clamped t has no gradient
  Pack16 time;            // t, clamped to ± kMaxReadoutShare of the readout: rows outside the image are not exposed

  GAUSSLITE_INLINE RowExposure() = default;
  GAUSSLITE_INLINE RowExposure(const Camera& camera, const Pack16& x, const Pack16& y, const Pack16& z,
                               const Pack16& inverse_z) {
    const float readout = camera.motion.readout_s, per_row = readout / float(camera.height);
    point_velocity(camera.motion, x, y, z, velocity);
    tangent_y = y * inverse_z;
    const Pack16 rows_per_s = fnma(tangent_y, velocity[2], velocity[1]) * inverse_z * camera.fy;
    readout_factor = max(fnma(rows_per_s, Pack16(per_row), Pack16(1.0f)), Pack16(kMinReadoutFactor));
    const Pack16 inverse_factor = Pack16(1.0f) / readout_factor;
    time_per_row = inverse_factor * per_row;
    unclamped_time =
        fma(tangent_y, Pack16(camera.fy * per_row), Pack16(camera.cy * per_row - 0.5f * readout)) * inverse_factor;
    const float limit = kMaxReadoutShare * (readout < 0.0f ? -readout : readout);
    time = min(max(unclamped_time, Pack16(-limit)), Pack16(limit));
  }

  // Moves the means to their places at the time of exposure.
  GAUSSLITE_INLINE void move(Pack16& x, Pack16& y, Pack16& z) const {
    x = fma(time, velocity[0], x);
    y = fma(time, velocity[1], y);
    z = fma(time, velocity[2], z);
  }
};

// Standard deviation, in seconds, of the times at which a pixel is exposed.
GAUSSLITE_INLINE float exposure_deviation_s(const CameraMotion& motion) {
  return motion.exposure_s * 0.28867513459481287f;  // 1 / sqrt(12)
}

}  // namespace gausslite::GAUSSLITE_ISA
