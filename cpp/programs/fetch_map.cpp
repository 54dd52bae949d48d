// gausslite_fetch_map HOST:PORT FILE.ply: write the fused map of a fusion server as a 3D Gaussian splatting PLY.
//
// SPDX-License-Identifier: Apache-2.0
#include <grpcpp/grpcpp.h>

#include <cmath>
#include <cstdio>
#include <exception>
#include <fstream>
#include <map>

#include "gausslite/subset.h"
#include "gausslite/v1/fusion_service.grpc.pb.h"

namespace {

namespace pb = gausslite::v1;
constexpr int max_message_bytes = 64 << 20;
constexpr float sh_degree_0 = 0.28209479177387814F;

using VoxelMap = std::map<std::int64_t, std::vector<gausslite::Gaussian>>;

/// Follow the fused map until the snapshot is complete. Throws DecodeError or runtime_error.
VoxelMap fetch(const std::string& address) {
    grpc::ChannelArguments arguments;
    arguments.SetMaxReceiveMessageSize(max_message_bytes);
    const auto channel = grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(), arguments);
    const auto stub = pb::FusionService::NewStub(channel);
    grpc::ClientContext context;
    const auto reader = stub->WatchFusedMap(&context, pb::WatchFusedMapRequest{});
    VoxelMap voxels;
    pb::WatchFusedMapResponse response;
    gausslite::Limits limits;
    limits.max_bytes = max_message_bytes;
    bool complete = false;
    while (!complete && reader->Read(&response)) {
        const auto& block = response.block();
        if (!block.subset().empty()) {
            for (auto& voxel : gausslite::decode_subset(block.subset(), limits).voxels) {
                if (voxel.gaussians.empty()) {
                    voxels.erase(voxel.key);
                } else {
                    voxels[voxel.key] = std::move(voxel.gaussians);
                }
            }
        }
        complete = block.last();
    }
    context.TryCancel();
    const auto status = reader->Finish();
    if (!complete) {
        throw std::runtime_error(address + ": " + status.error_message());
    }
    return voxels;
}

void write_floats(std::ostream& out, std::initializer_list<float> values) {
    for (const auto value : values) {
        // PLY states little-endian numbers, as all supported machines have them
        out.write(reinterpret_cast<const char*>(&value), sizeof value);
    }
}

std::size_t write_ply(const std::string& path, const VoxelMap& voxels) {
    std::size_t count = 0;
    for (const auto& [key, gaussians] : voxels) {
        count += gaussians.size();
    }
    std::ofstream out(path, std::ios::binary);
    out << "ply\nformat binary_little_endian 1.0\nelement vertex " << count << "\n";
    for (const auto* name : {"x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0",
                             "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"}) {
        out << "property float " << name << "\n";
    }
    out << "end_header\n";
    for (const auto& [key, gaussians] : voxels) {
        for (const auto& g : gaussians) {
            write_floats(out, {g.mean_m[0], g.mean_m[1], g.mean_m[2], 0.0F, 0.0F, 0.0F});
            for (const auto value : g.rgb) {
                write_floats(out, {(value - 0.5F) / sh_degree_0});
            }
            write_floats(out, {std::log(g.opacity / (1.0F - g.opacity)), std::log(g.scales_m[0]),
                               std::log(g.scales_m[1]), std::log(g.scales_m[2])});
            write_floats(out, {g.quat_wxyz[0], g.quat_wxyz[1], g.quat_wxyz[2], g.quat_wxyz[3]});
        }
    }
    out.close();
    if (!out) {
        throw std::runtime_error(path + ": expected a writable file");
    }
    return count;
}

}  // namespace

int main(int count, char** arguments) try {
    if (count != 3) {
        std::fprintf(stderr, "usage: gausslite_fetch_map HOST:PORT FILE.ply\n");
        return 2;
    }
    const auto voxels = fetch(arguments[1]);
    const auto gaussians = write_ply(arguments[2], voxels);
    std::printf("%zu Gaussians in %zu voxels -> %s\n", gaussians, voxels.size(), arguments[2]);
    return 0;
} catch (const std::exception& error) {
    std::fprintf(stderr, "gausslite_fetch_map: %s\n", error.what());
    return 2;
}
