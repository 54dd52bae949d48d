// SPDX-License-Identifier: Apache-2.0
// EWA projection of sixteen 3D Gaussians to 2D Gaussians in the image (Kerbl et al. 2023, Sec. 4). The backward pass
// repeats it, because it needs the intermediate values.
#pragma once

#include "camera.h"
#include "motion.h"
#include "row_layout.h"
#include "simd/pack.h"

namespace gausslite::GAUSSLITE_ISA {

// A moving camera's part of a projection. The readout shears an ellipse, and the exposure stretches it: the image is
// the mean over the times of a pixel's exposure, which have the covariance exposure^2 / 12. A stretched splat is
// fainter.
struct ProjectionMotion {
  RowExposure exposure;
  Pack16 x, y, z;                        // the mean in the camera frame at the middle of the readout
  Pack16 velocity[3], image_x, image_y;  // at the time of exposure: velocity in the camera frame, and in px/s
  Pack16 shear, stretch;                 // P0 += shear P1, then P1 *= stretch
  Pack16 unsheared_P1[3];
  Pack16 blur_x, blur_y;             // standard deviation of the mean's image during the exposure, px
  Pack16 minor[3];                   // blur_x M1 - blur_y M0
  Pack16 sharp_inverse_determinant;  // of the image covariance without blur
};

struct Projection {
  Pack16 x, y, z, inverse_z;            // the mean in the camera frame, at the time of exposure
  Pack16 u, v, u_clamped, v_clamped;    // tangents x/z, y/z; the clamped ones enter the Jacobian
  Pack16 J00, J02, J11, J12;            // Jacobian of the projection: [[J00 0 J02] [0 J11 J12]]
  Pack16 P0[3], P1[3];                  // rows of P = J R_camera_world
  Pack16 R[3][3], scale[3];             // the splat's rotation and scales
  Pack16 M0[3], M1[3];                  // rows of M = P R S; the image covariance is M M^T + d I
  Pack16 qw, qx, qy, qz, inverse_norm;  // the unit quaternion, and 1 / the length of the raw one
  Pack16 cov_xx, cov_xy, cov_yy;        // image covariance, px^2
  Pack16 conic_xx, conic_xy, conic_yy;  // its inverse
  Pack16 cross[3];                      // M0 x M1
  float dilation_px2;                   // d
  Pack16 inverse_determinant;           // of the image covariance
  Pack16 mean_x, mean_y;                // px
  Pack16 transparency, log2_opacity;  // 1 - opacity, and log2(opacity), with a moving camera that of the blurred splat
  ProjectionMotion motion;            // of a moving camera only
};

GAUSSLITE_INLINE Pack16 dot3(const Pack16* a, const Pack16* b) { return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2])); }
GAUSSLITE_INLINE Pack16 dot3(const Pack16* a, const float* b) {
  return fma(a[0], Pack16(b[0]), fma(a[1], Pack16(b[1]), a[2] * Pack16(b[2])));
}

GAUSSLITE_INLINE void to_camera_frame(const Pack16* row, const Camera& camera, Pack16& x, Pack16& y, Pack16& z) {
  const float* R = camera.R_camera_world;
  x = dot3(row, R) + camera.t_camera_world[0];
  y = dot3(row, R + 3) + camera.t_camera_world[1];
  z = dot3(row, R + 6) + camera.t_camera_world[2];
}

GAUSSLITE_INLINE void move_to_exposure(const Camera& camera, Projection& o) {
  ProjectionMotion& m = o.motion;
  m.x = o.x;
  m.y = o.y;
  m.z = o.z;
  m.exposure = RowExposure(camera, o.x, o.y, o.z, Pack16(1.0f) / o.z);
  m.exposure.move(o.x, o.y, o.z);
  point_velocity(camera.motion, o.x, o.y, o.z, m.velocity);
}

GAUSSLITE_INLINE void shear_by_readout(const Camera& camera, Projection& o) {
  ProjectionMotion& m = o.motion;
  m.image_x = fma(o.J00, m.velocity[0], o.J02 * m.velocity[2]);
  m.image_y = fma(o.J11, m.velocity[1], o.J12 * m.velocity[2]);
  m.blur_x = m.image_x * exposure_deviation_s(camera.motion);
  m.blur_y = m.image_y * exposure_deviation_s(camera.motion);
  m.shear = m.exposure.time_per_row * m.image_x;
  m.stretch = fma(m.exposure.time_per_row, m.image_y, Pack16(1.0f));
  for (int j = 0; j < 3; ++j) {
    m.unsheared_P1[j] = o.P1[j];
    o.P0[j] = fma(m.shear, o.P1[j], o.P0[j]);
    o.P1[j] = m.stretch * o.P1[j];
  }
}

GAUSSLITE_INLINE void rotate_and_scale(const Pack16* row, Projection& o) {
  const Pack16 *q = row + kQuat, one(1.0f);
  o.inverse_norm = one / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  o.qw = q[0] * o.inverse_norm;
  o.qx = q[1] * o.inverse_norm;
  o.qy = q[2] * o.inverse_norm;
  o.qz = q[3] * o.inverse_norm;
  const Pack16 x2 = o.qx + o.qx, y2 = o.qy + o.qy, z2 = o.qz + o.qz;
  const Pack16 xx = o.qx * x2, yy = o.qy * y2, zz = o.qz * z2, xy = o.qx * y2, xz = o.qx * z2, yz = o.qy * z2;
  const Pack16 wx = o.qw * x2, wy = o.qw * y2, wz = o.qw * z2;
  o.R[0][0] = one - (yy + zz);
  o.R[0][1] = xy - wz;
  o.R[0][2] = xz + wy;
  o.R[1][0] = xy + wz;
  o.R[1][1] = one - (xx + zz);
  o.R[1][2] = yz - wx;
  o.R[2][0] = xz - wy;
  o.R[2][1] = yz + wx;
  o.R[2][2] = one - (xx + yy);
  for (int j = 0; j < 3; ++j) o.scale[j] = exp(row[kLogScale + j]);
}

// The determinant of M M^T is |M0 x M1|^2, so that of M M^T + d I is |M0 x M1|^2 + d (|M0|^2 + |M1|^2) + d^2: a sum of
// squares without the cancellation of cov_xx cov_yy - cov_xy^2, which ruins needle-shaped splats in single precision.
// Blur adds b b^T to the covariance, a fourth axis b = (blur_x, blur_y) beside the columns of M.
template <bool kMotion>
GAUSSLITE_INLINE void invert_covariance(Projection& o) {
  const Pack16 square0 = dot3(o.M0, o.M0), square1 = dot3(o.M1, o.M1);
  o.cov_xx = square0 + o.dilation_px2;
  o.cov_yy = square1 + o.dilation_px2;
  o.cov_xy = dot3(o.M0, o.M1);
  o.cross[0] = o.M0[1] * o.M1[2] - o.M0[2] * o.M1[1];
  o.cross[1] = o.M0[2] * o.M1[0] - o.M0[0] * o.M1[2];
  o.cross[2] = o.M0[0] * o.M1[1] - o.M0[1] * o.M1[0];
  Pack16 determinant =
      dot3(o.cross, o.cross) + fma(Pack16(o.dilation_px2), square0 + square1, Pack16(o.dilation_px2 * o.dilation_px2));
  if constexpr (kMotion) {
    ProjectionMotion& m = o.motion;
    m.sharp_inverse_determinant = Pack16(1.0f) / determinant;
    for (int j = 0; j < 3; ++j) m.minor[j] = m.blur_x * o.M1[j] - m.blur_y * o.M0[j];
    const Pack16 square_x = m.blur_x * m.blur_x, square_y = m.blur_y * m.blur_y;
    determinant = determinant + fma(Pack16(o.dilation_px2), square_x + square_y, dot3(m.minor, m.minor));
    o.cov_xx = o.cov_xx + square_x;
    o.cov_yy = o.cov_yy + square_y;
    o.cov_xy = fma(m.blur_x, m.blur_y, o.cov_xy);
  }
  o.inverse_determinant = Pack16(1.0f) / determinant;
  o.conic_xx = o.cov_yy * o.inverse_determinant;
  o.conic_xy = -(o.cov_xy * o.inverse_determinant);
  o.conic_yy = o.cov_xx * o.inverse_determinant;
}

// `row` holds sixteen parameter rows, transposed: row[k] is column k. kMotion: whether the camera moves.
template <bool kMotion>
GAUSSLITE_INLINE void project16(const Pack16* row, const Camera& camera, Projection& o) {
  to_camera_frame(row, camera, o.x, o.y, o.z);
  if constexpr (kMotion) move_to_exposure(camera, o);
  o.inverse_z = Pack16(1.0f) / o.z;
  o.u = o.x * o.inverse_z;
  o.v = o.y * o.inverse_z;
  const float limit_u = kTangentLimitFactor * 0.5f * float(camera.width) / camera.fx;
  const float limit_v = kTangentLimitFactor * 0.5f * float(camera.height) / camera.fy;
  o.u_clamped = min(max(o.u, Pack16(-limit_u)), Pack16(limit_u));
  o.v_clamped = min(max(o.v, Pack16(-limit_v)), Pack16(limit_v));
  o.mean_x = fma(o.u, Pack16(camera.fx), Pack16(camera.cx));
  o.mean_y = fma(o.v, Pack16(camera.fy), Pack16(camera.cy));
  o.J00 = o.inverse_z * camera.fx;
  o.J11 = o.inverse_z * camera.fy;
  o.J02 = -(o.J00 * o.u_clamped);
  o.J12 = -(o.J11 * o.v_clamped);

  rotate_and_scale(row, o);
  const float* R = camera.R_camera_world;
  for (int j = 0; j < 3; ++j) {
    o.P0[j] = fma(o.J00, Pack16(R[j]), o.J02 * R[6 + j]);
    o.P1[j] = fma(o.J11, Pack16(R[3 + j]), o.J12 * R[6 + j]);
  }
  if constexpr (kMotion) shear_by_readout(camera, o);
  for (int j = 0; j < 3; ++j) {
    const Pack16 axis[3] = {o.R[0][j], o.R[1][j], o.R[2][j]};
    o.M0[j] = dot3(o.P0, axis) * o.scale[j];
    o.M1[j] = dot3(o.P1, axis) * o.scale[j];
  }
  o.dilation_px2 = camera.dilation_px2;
  invert_covariance<kMotion>(o);

  // exp(-logit) / denominator keeps its precision at opacities near 1, unlike 1 - opacity.
  const Pack16 e = exp(-row[kLogit]), denominator = Pack16(1.0f) + e;
  o.transparency = e / denominator;
  o.log2_opacity = -log2(denominator);
  if constexpr (kMotion) {
    // The blurred splat has the same integral over the image: the peak falls with the root of the determinant.
    o.log2_opacity =
        fma(log2(o.inverse_determinant / o.motion.sharp_inverse_determinant), Pack16(0.5f), o.log2_opacity);
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
