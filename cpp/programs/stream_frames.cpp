// gausslite_stream_frames HOST:PORT FOLDER "TASK": assign a task to an agent, send a folder's frames, end the mission.
//
// FOLDER has camera.txt ("fx fy cx cy width height", in pixels) and, for each frame, NAME.color.png (or .jpg),
// NAME.depth.png (16 bits, millimetres, 0 = no return) and NAME.pose.txt (T_world_camera, 4 rows of 4 numbers). The
// images are sent as they are.
//
// SPDX-License-Identifier: Apache-2.0
#include <grpcpp/grpcpp.h>

#include <algorithm>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "gausslite/v1/agent_service.grpc.pb.h"

namespace {

namespace fs = std::filesystem;
namespace pb = gausslite::v1;
constexpr std::int64_t frame_interval_ns = 33'333'333;
constexpr int keepalive_ms = 15'000;

std::string read_file(const fs::path& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) {
        throw std::runtime_error(path.string() + ": expected a readable file");
    }
    return {std::istreambuf_iterator<char>(file), {}};
}

std::vector<double> read_numbers(const fs::path& path, std::size_t count) {
    std::istringstream text(read_file(path));
    const std::vector<double> numbers{std::istream_iterator<double>(text), {}};
    if (numbers.size() != count) {
        throw std::runtime_error(path.string() + ": expected " + std::to_string(count) + " numbers, got " +
                                 std::to_string(numbers.size()));
    }
    return numbers;
}

pb::Camera read_camera(const fs::path& folder) {
    const auto numbers = read_numbers(folder / "camera.txt", 6);
    pb::Camera camera;
    camera.set_fx_px(numbers[0]);
    camera.set_fy_px(numbers[1]);
    camera.set_cx_px(numbers[2]);
    camera.set_cy_px(numbers[3]);
    camera.set_width_px(static_cast<std::uint32_t>(numbers[4]));
    camera.set_height_px(static_cast<std::uint32_t>(numbers[5]));
    return camera;
}

std::vector<std::string> frame_names(const fs::path& folder) {
    const std::string suffix = ".pose.txt";
    std::vector<std::string> names;
    for (const auto& entry : fs::directory_iterator(folder)) {
        const auto name = entry.path().filename().string();
        if (name.size() > suffix.size() && name.compare(name.size() - suffix.size(), suffix.size(), suffix) == 0) {
            names.push_back(name.substr(0, name.size() - suffix.size()));
        }
    }
    std::sort(names.begin(), names.end());
    if (names.empty()) {
        throw std::runtime_error(folder.string() + ": expected files NAME.pose.txt, got none");
    }
    return names;
}

pb::EncodedFrame read_frame(const fs::path& folder, const std::string& name, const pb::Camera& camera,
                            std::int64_t index) {
    pb::EncodedFrame frame;
    frame.set_index(index);
    frame.set_capture_time_ns(index * frame_interval_ns);
    const auto png = folder / (name + ".color.png");
    frame.set_colour(read_file(fs::exists(png) ? png : folder / (name + ".color.jpg")));
    frame.set_depth_png(read_file(folder / (name + ".depth.png")));
    *frame.mutable_camera() = camera;
    for (const auto number : read_numbers(folder / (name + ".pose.txt"), 16)) {
        frame.mutable_t_world_camera()->add_row_major(number);
    }
    return frame;
}

void require_ok(const grpc::Status& status) {
    if (!status.ok()) {
        throw std::runtime_error(status.error_message());
    }
}

/// Send all frames while another thread reads the outcomes; returns the number of mapped frames.
int stream(pb::AgentService::Stub& stub, const fs::path& folder) {
    const auto camera = read_camera(folder);
    const auto names = frame_names(folder);
    grpc::ClientContext context;
    const auto call = stub.IngestFrames(&context);
    int mapped = 0;
    std::thread outcomes([&] {
        pb::IngestFramesResponse response;
        while (call->Read(&response)) {
            mapped += response.outcome() == pb::FRAME_OUTCOME_MAPPED;
            if (!response.reason().empty()) {
                std::fprintf(stderr, "frame %lld: %s\n", static_cast<long long>(response.index()),
                             response.reason().c_str());
            }
        }
    });
    std::exception_ptr failure;
    try {
        for (std::size_t i = 0; i < names.size(); ++i) {
            pb::IngestFramesRequest request;
            *request.mutable_frame() = read_frame(folder, names[i], camera, static_cast<std::int64_t>(i));
            if (!call->Write(request)) {
                break;
            }
        }
    } catch (...) {
        failure = std::current_exception();
    }
    call->WritesDone();
    outcomes.join();
    const auto status = call->Finish();
    if (failure) {
        std::rethrow_exception(failure);
    }
    require_ok(status);
    return mapped;
}

}  // namespace

int main(int count, char** arguments) try {
    if (count != 4) {
        std::fprintf(stderr, "usage: gausslite_stream_frames HOST:PORT FOLDER \"TASK\"\n");
        return 2;
    }
    // else a half-open connection would wait for the system's timeout, which is many minutes
    grpc::ChannelArguments pings;
    pings.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, keepalive_ms);
    pings.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, keepalive_ms);
    pings.SetInt(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);
    const auto stub = pb::AgentService::NewStub(
        grpc::CreateCustomChannel(arguments[1], grpc::InsecureChannelCredentials(), pings));
    pb::AssignTaskRequest task;
    task.set_text(arguments[3]);
    pb::AssignTaskResponse graph;
    grpc::ClientContext assign_context, end_context;
    require_ok(stub->AssignTask(&assign_context, task, &graph));
    const int mapped = stream(*stub, arguments[2]);
    pb::EndMissionResponse end;
    require_ok(stub->EndMission(&end_context, pb::EndMissionRequest{}, &end));
    std::printf("%d frames mapped; %s\n", mapped, end.summary().c_str());
    return 0;
} catch (const std::exception& error) {
    std::fprintf(stderr, "gausslite_stream_frames: %s\n", error.what());
    return 2;
}
