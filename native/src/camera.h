// SPDX-License-Identifier: Apache-2.0
// The pinhole camera and the constants of the image model.
#pragma once

namespace gausslite {

// Velocity of the camera in its own axes while the rows of an image are exposed one after the other.
struct CameraMotion {
  float linear_m_s[3] = {}, angular_rad_s[3] = {};
  float readout_s = 0.0f, exposure_s = 0.0f;
};

struct Camera {
  float R_camera_world[9];
  float t_camera_world[3];
  float fx, fy, cx, cy;  // pixels; pixel (u, v) has its centre at (u + 0.5, v + 0.5)
  int width, height;
  float dilation_px2;  // added to the diagonal of the 2D covariance
  bool moves = false;  // whether the image model includes `motion`
  CameraMotion motion;
};

constexpr float kNearPlaneM = 0.05f;  // splats with a mean at smaller depth are culled
// Tangents x/z and y/z in the Jacobian are clamped to this factor times the tangent of half the field of view.
constexpr float kTangentLimitFactor = 1.3f;
// The exposure time of a mean outside the image is limited to this share of the readout, before and after its middle.
constexpr float kMaxReadoutShare = 0.65f;
// Smallest readout factor (motion.h). The factor is 0 for a mean that moves down the image as fast as the readout.
constexpr float kMinReadoutFactor = 0.5f;
constexpr float kMinTransmittance = 1e-4f;             // blending of a pixel ends below it
constexpr float kLog2MinAlpha = -7.99435343685886f;    // log2(1/255): weaker contributions are dropped
constexpr float kLog2MaxAlpha = -0.0144995696951151f;  // log2(0.99): alpha is clamped there, without a gradient
constexpr float kMinSurfaceAlpha = 0.5f;               // the depth loss ignores pixels of lower alpha

constexpr int kTileSide = 16;       // pixels per side
constexpr int kBlockSide = 4;       // pixels per side; the 16 pixels of a block are one Pack16
constexpr int kBlocksPerTile = 16;  // 4 x 4
constexpr int kBlocksPerSide = 4;

}  // namespace gausslite
