// SPDX-License-Identifier: Apache-2.0
// Backward pass of the projection for sixteen splats: from image gradients to gradients of the parameters and of the
// camera pose.
#pragma once

#include "projection.h"

namespace gausslite::GAUSSLITE_ISA {

// Gradients of sixteen parameter rows, transposed; the norm of the gradient of the 2D mean, in units of half the image
// width and height; with kTwist, each splat's gradient of the camera twist (translation, rotation).
struct ParameterGradients {
  Pack16 column[16];
  Pack16 mean_2d_grad_norm;
  Pack16 twist[6];
};

// Computes K m for column j of M, where K is the conic. K (M M^T + d I) = I, and the adjugate of a sum of 2x2 matrices
// is the sum of their adjugates. So K m_j = (sum over i of n_i (n_i m_j) + d m_j) / determinant, with n_i = m_i rotated
// by 90 degrees. n_j m_j is exactly zero, which avoids the cancellation that the entries of K have for needle-shaped
// splats.
GAUSSLITE_INLINE void scaled_conic_times_axis(const Projection& p, int j, Pack16& x, Pack16& y) {
  const int k = (j + 1) % 3, l = (j + 2) % 3;
  x = p.M1[k] * p.cross[l] - p.M1[l] * p.cross[k] + p.M0[j] * p.dilation_px2;
  y = p.M0[l] * p.cross[k] - p.M0[k] * p.cross[l] + p.M1[j] * p.dilation_px2;
}

GAUSSLITE_INLINE void conic_times_axis(const Projection& p, int j, Pack16& x, Pack16& y) {
  scaled_conic_times_axis(p, j, x, y);
  x = x * p.inverse_determinant;
  y = y * p.inverse_determinant;
}

// The same with blur, a fourth axis b with n_b m_j = -minor[j]. Blur scales alpha by sqrt(sharp determinant /
// determinant). `fainter` is the gradient of the logarithm of this factor with respect to m_j: the conic without blur
// times m_j, minus the conic times m_j.
GAUSSLITE_INLINE void conic_times_blurred_axis(const Projection& p, int j, Pack16& x, Pack16& y, Pack16& fainter_x,
                                               Pack16& fainter_y) {
  const ProjectionMotion& m = p.motion;
  Pack16 sharp_x, sharp_y;
  scaled_conic_times_axis(p, j, sharp_x, sharp_y);
  x = fnma(m.blur_y, m.minor[j], sharp_x) * p.inverse_determinant;
  y = fma(m.blur_x, m.minor[j], sharp_y) * p.inverse_determinant;
  fainter_x = sharp_x * m.sharp_inverse_determinant - x;
  fainter_y = sharp_y * m.sharp_inverse_determinant - y;
}

// Gradients through the terms of a moving camera, from the covariance back to the mean at the middle of the readout.
struct MotionGradients {
  Pack16 d_image_x, d_image_y;  // of the velocity of the mean's image
  Pack16 d_time_per_row;

  // Replaces the gradients of the sheared rows of P by those of the rows before the shear.
  GAUSSLITE_INLINE void from_covariance(const Projection& p, const Camera& camera, const Pack16* image,
                                        Pack16 (&d_P0)[3], Pack16 (&d_P1)[3]) {
    const ProjectionMotion& m = p.motion;
    const Pack16 *moments = image + kGradientMoments, S_xx = moments[3], S_xy = moments[4], S_yy = moments[5];
    // The conic times b, as in scaled_conic_times_axis.
    const Pack16 x = fma(m.blur_x, Pack16(p.dilation_px2), dot3(p.M1, m.minor)) * p.inverse_determinant;
    const Pack16 y = (m.blur_y * p.dilation_px2 - dot3(p.M0, m.minor)) * p.inverse_determinant;
    const Pack16 Sx = S_xx * x + S_xy * y, Sy = S_xy * x + S_yy * y;
    const float deviation_s = exposure_deviation_s(camera.motion);
    const Pack16 d_blur_x = p.conic_xx * Sx + p.conic_xy * Sy - image[0] * x;
    const Pack16 d_blur_y = p.conic_xy * Sx + p.conic_yy * Sy - image[0] * y;

    const Pack16 d_shear = dot3(d_P0, m.unsheared_P1), d_stretch = dot3(d_P1, m.unsheared_P1);
    for (int i = 0; i < 3; ++i) d_P1[i] = fma(m.shear, d_P0[i], m.stretch * d_P1[i]);
    d_image_x = fma(m.exposure.time_per_row, d_shear, d_blur_x * deviation_s);
    d_image_y = fma(m.exposure.time_per_row, d_stretch, d_blur_y * deviation_s);
    d_time_per_row = fma(m.image_x, d_shear, m.image_y * d_stretch);
  }

  // The velocity of the image is the Jacobian times the velocity in the camera frame.
  GAUSSLITE_INLINE void add_to_jacobian(const Projection& p, Pack16& d_J00, Pack16& d_J02, Pack16& d_J11,
                                        Pack16& d_J12) const {
    const Pack16* velocity = p.motion.velocity;
    d_J00 = fma(d_image_x, velocity[0], d_J00);
    d_J02 = fma(d_image_x, velocity[2], d_J02);
    d_J11 = fma(d_image_y, velocity[1], d_J11);
    d_J12 = fma(d_image_y, velocity[2], d_J12);
  }

  // Replaces the gradient of the mean at its exposure by that of the mean at the middle of the readout.
  GAUSSLITE_INLINE void move_to_readout_middle(const Projection& p, const Camera& camera, Pack16 (&d)[3]) const {
    const ProjectionMotion& m = p.motion;
    const RowExposure& e = m.exposure;
    const Pack16 d_velocity[3] = {p.J00 * d_image_x, p.J11 * d_image_y, fma(p.J02, d_image_x, p.J12 * d_image_y)};
    add_velocity_gradient(camera.motion, d_velocity, d);

    // Backward through t, which has no gradient where it is clamped, and through time_per_row.
    const float per_row = camera.motion.readout_s / float(camera.height);
    const Pack16 inverse_z = Pack16(1.0f) / m.z, fy(camera.fy);
    const Pack16 d_time = zero_unless(e.time == e.unclamped_time, dot3(d, e.velocity));
    const Pack16 d_factor = zero_unless(e.readout_factor > Pack16(kMinReadoutFactor),
                                        (d_time * e.time + d_time_per_row * e.time_per_row) / e.readout_factor);
    const Pack16 d_rows_per_s = d_factor * per_row * fy;  // signs cancel: f falls with s, and t falls with f
    const Pack16 d_moving[3] = {e.time * d[0], fma(e.time, d[1], d_rows_per_s * inverse_z),
                                fnma(d_rows_per_s * inverse_z, e.tangent_y, e.time * d[2])};
    const Pack16 d_tangent = fy * d_time * e.time_per_row - d_rows_per_s * inverse_z * e.velocity[2];
    const Pack16 d_inverse_z = fma(d_rows_per_s, fnma(e.tangent_y, e.velocity[2], e.velocity[1]), d_tangent * m.y);
    add_velocity_gradient(camera.motion, d_moving, d);
    d[1] = fma(d_tangent, inverse_z, d[1]);
    d[2] = fnma(d_inverse_z, inverse_z * inverse_z, d[2]);
  }

 private:
  // Adds the gradient of a point by that of its velocity -(v + w x p): w x gradient.
  GAUSSLITE_INLINE static void add_velocity_gradient(const CameraMotion& motion, const Pack16 (&of)[3],
                                                     Pack16 (&d)[3]) {
    const float* w = motion.angular_rad_s;
    d[0] = d[0] + of[2] * w[1] - of[1] * w[2];
    d[1] = d[1] + of[0] * w[2] - of[2] * w[0];
    d[2] = d[2] + of[1] * w[0] - of[0] * w[1];
  }
};

// `d_R` is the gradient of the rotation matrix of the unit quaternion; the result is that of the raw quaternion.
GAUSSLITE_INLINE void quaternion_gradient(const Projection& p, const Pack16 (&d_R)[3][3], Pack16* out) {
  const Pack16 w = p.qw, x = p.qx, y = p.qy, z = p.qz;
  const Pack16 minus_x = d_R[2][1] - d_R[1][2], minus_y = d_R[0][2] - d_R[2][0], minus_z = d_R[1][0] - d_R[0][1];
  const Pack16 plus_x = d_R[2][1] + d_R[1][2], plus_y = d_R[0][2] + d_R[2][0], plus_z = d_R[1][0] + d_R[0][1];
  const Pack16 two(2.0f);
  const Pack16 g[4] = {x * minus_x + y * minus_y + z * minus_z,
                       y * plus_z + z * plus_y + w * minus_x - two * x * (d_R[1][1] + d_R[2][2]),
                       x * plus_z + z * plus_x + w * minus_y - two * y * (d_R[0][0] + d_R[2][2]),
                       x * plus_y + y * plus_x + w * minus_z - two * z * (d_R[0][0] + d_R[1][1])};
  const Pack16 along = w * g[0] + x * g[1] + y * g[2] + z * g[3], scale = p.inverse_norm * 2.0f;
  out[0] = (g[0] - w * along) * scale;
  out[1] = (g[1] - x * along) * scale;
  out[2] = (g[2] - y * along) * scale;
  out[3] = (g[3] - z * along) * scale;
}

// `row`: parameters, `image`: image gradient rows (row_layout.h), both transposed.
template <bool kTwist, bool kMotion>
GAUSSLITE_INLINE void backward16(const Pack16* row, const Pack16* image, const Camera& camera,
                                 ParameterGradients& out) {
  Projection p;
  project16<kMotion>(row, camera, p);
  const float* R = camera.R_camera_world;

  const Pack16 d_mean_x = p.conic_xx * image[1] + p.conic_xy * image[2];
  const Pack16 d_mean_y = p.conic_xy * image[1] + p.conic_yy * image[2];
  const Pack16 half_x = d_mean_x * (0.5f * float(camera.width)), half_y = d_mean_y * (0.5f * float(camera.height));
  out.mean_2d_grad_norm = sqrt(half_x * half_x + half_y * half_y);

  // Covariance = M M^T + d I with M = P R S. As ln(alpha) = ... - d^T K d / 2, column m of M has the gradient K S K
  // m, where S is the matrix of second moments of v.
  const Pack16 *moments = image + kGradientMoments, S_xx = moments[3], S_xy = moments[4], S_yy = moments[5];
  Pack16 d_P0[3] = {0.0f, 0.0f, 0.0f}, d_P1[3] = {0.0f, 0.0f, 0.0f}, d_R[3][3];
  for (int j = 0; j < 3; ++j) {
    Pack16 x, y, fainter_x, fainter_y;
    if constexpr (kMotion) {
      conic_times_blurred_axis(p, j, x, y, fainter_x, fainter_y);
    } else {
      conic_times_axis(p, j, x, y);
    }
    const Pack16 Sx = S_xx * x + S_xy * y, Sy = S_xy * x + S_yy * y;
    out.column[kLogScale + j] = x * Sx + y * Sy;
    Pack16 d_M0 = p.conic_xx * Sx + p.conic_xy * Sy, d_M1 = p.conic_xy * Sx + p.conic_yy * Sy;
    if constexpr (kMotion) {
      fainter_x = fainter_x * image[0];
      fainter_y = fainter_y * image[0];
      out.column[kLogScale + j] = out.column[kLogScale + j] + p.M0[j] * fainter_x + p.M1[j] * fainter_y;
      d_M0 = d_M0 + fainter_x;
      d_M1 = d_M1 + fainter_y;
    }
    const Pack16 scaled0 = d_M0 * p.scale[j], scaled1 = d_M1 * p.scale[j];
    for (int i = 0; i < 3; ++i) {
      d_R[i][j] = p.P0[i] * scaled0 + p.P1[i] * scaled1;
      d_P0[i] = fma(scaled0, p.R[i][j], d_P0[i]);
      d_P1[i] = fma(scaled1, p.R[i][j], d_P1[i]);
    }
  }
  quaternion_gradient(p, d_R, out.column + kQuat);
  MotionGradients motion;
  if constexpr (kMotion) motion.from_covariance(p, camera, image, d_P0, d_P1);

  // P = J R_camera_world; the Jacobian is constant where the tangent is clamped.
  Pack16 d_J00 = dot3(d_P0, R), d_J02 = dot3(d_P0, R + 6), d_J11 = dot3(d_P1, R + 3), d_J12 = dot3(d_P1, R + 6);
  const Pack16 rotated_J00 = d_J00, rotated_J02 = d_J02, rotated_J11 = d_J11, rotated_J12 = d_J12;
  if constexpr (kMotion) motion.add_to_jacobian(p, d_J00, d_J02, d_J11, d_J12);
  const Pack16 d_u = fma(d_mean_x, Pack16(camera.fx), zero_unless(p.u == p.u_clamped, -(p.J00 * d_J02)));
  const Pack16 d_v = fma(d_mean_y, Pack16(camera.fy), zero_unless(p.v == p.v_clamped, -(p.J11 * d_J12)));
  const Pack16 d_inverse_z =
      (d_J00 - p.u_clamped * d_J02) * camera.fx + (d_J11 - p.v_clamped * d_J12) * camera.fy + d_u * p.x + d_v * p.y;
  Pack16 d_camera[3] = {d_u * p.inverse_z, d_v * p.inverse_z,
                        image[kColourSums + 3] - p.inverse_z * p.inverse_z * d_inverse_z};
  if constexpr (kMotion) motion.move_to_readout_middle(p, camera, d_camera);
  for (int j = 0; j < 3; ++j) {
    out.column[kMean + j] = d_camera[0] * R[j] + d_camera[1] * R[3 + j] + d_camera[2] * R[6 + j];
  }
  out.column[kLogit] = image[0] * p.transparency;
  for (int k = 0; k < 3; ++k) out.column[kRgb + k] = image[kColourSums + k];
  out.column[14] = out.column[15] = Pack16(0.0f);

  if constexpr (kTwist) {
    // T <- exp(twist) T moves a camera-frame point by t + r x point and rotates R_camera_world by r. With N = (dL/dR)
    // R^T, the gradient of the rotation is the axis of N - N^T; dL/dR = J^T (dL/dP).
    const Pack16 a01 = dot3(d_P0, R + 3), a10 = dot3(d_P1, R);
    const Pack16 n01 = p.J00 * a01, n02 = p.J00 * rotated_J02, n10 = p.J11 * a10, n12 = p.J11 * rotated_J12;
    const Pack16 n20 = p.J02 * rotated_J00 + p.J12 * a10, n21 = p.J02 * a01 + p.J12 * rotated_J11;
    Pack16 x = p.x, y = p.y, z = p.z;
    if constexpr (kMotion) {
      x = p.motion.x;
      y = p.motion.y;
      z = p.motion.z;
    }
    for (int k = 0; k < 3; ++k) out.twist[k] = d_camera[k];
    out.twist[3] = y * d_camera[2] - z * d_camera[1] + n21 - n12;
    out.twist[4] = z * d_camera[0] - x * d_camera[2] + n02 - n20;
    out.twist[5] = x * d_camera[1] - y * d_camera[0] + n10 - n01;
  }
}

// Sets gradients with a NaN or infinite entry, of degenerate splats, to zero, so that they do not change their rows.
GAUSSLITE_INLINE void zero_invalid(ParameterGradients& g) {
  Pack16 total = g.mean_2d_grad_norm * 0.0f;
  for (int k = 0; k < kTrainedColumns; ++k) total = fma(g.column[k], Pack16(0.0f), total);
  const Mask16 valid = total == Pack16(0.0f);
  for (int k = 0; k < kTrainedColumns; ++k) g.column[k] = zero_unless(valid, g.column[k]);
  g.mean_2d_grad_norm = zero_unless(valid, g.mean_2d_grad_norm);
}

}  // namespace gausslite::GAUSSLITE_ISA
