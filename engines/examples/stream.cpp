// stream ADDRESS SCENE FRAMES [SCENE_FILE]: frames of a service along 10 mm of elevation, over gRPC, one after another to
// the standard output. With the scene's file each is rendered here, too, and the largest difference is told.
//
// The newest pose goes first, and a call that breaks is followed by another: what a robot or an engine wants.
#include <grpcpp/grpcpp.h>

#include <chrono>
#include <iostream>
#include <optional>
#include <set>
#include <thread>

#include "local_frames.hpp"
#include "ultragray/v1/rendering.grpc.pb.h"

namespace v1 = ultragray::v1;

namespace {

constexpr int HEIGHT = 128, WIDTH = 96;
const std::set<std::string> PASSING = {"NOT_READY", "DRAINING",
                                       "QUEUE_FULL"};  // refusals of a service that starts, stops or is busy

class FrameStream {
 public:
    FrameStream(const std::string& address, std::string scene)
        : stub_(v1::RenderService::NewStub(grpc::CreateChannel(address, grpc::InsecureChannelCredentials()))),
          scene_(std::move(scene)) {
        open();
    }
    ~FrameStream() { context_->TryCancel(), call_->Finish(); }

    // The frame of a pose. Waits as long as the service is away. Throws std::runtime_error for a pose that is refused.
    v1::Frame render(const Pose& pose) {
        v1::RenderStreamRequest request;
        request.set_sequence(++sequence_);
        for (const double value : pose.matrix) request.mutable_pose()->mutable_matrix()->add_values(value);
        v1::Frame frame;
        while (true) {
            if (!ask(request) || !call_->Read(&frame)) {
                const grpc::Status status = call_->Finish();
                if (status.error_code() != grpc::StatusCode::UNAVAILABLE) throw std::runtime_error(status.error_message());
                std::cerr << "the stream broke, and is opened again: " << status.error_message() << "\n";
                open();
                continue;
            }
            answered_ = frame.sequence();
            if (!frame.has_error()) return frame;
            if (PASSING.count(frame.error().reason()) == 0) throw std::runtime_error(frame.error().detail());
            std::this_thread::sleep_for(std::chrono::milliseconds(200));
            is_first_ = true;  // the settings may have been refused with it
        }
    }

 private:
    void open() {
        context_ = std::make_unique<grpc::ClientContext>();
        context_->set_wait_for_ready(true);
        // context_->AddMetadata("x-api-key", key);  where the service asks for one
        call_ = stub_->RenderStream(context_.get());
        is_first_ = true;
    }

    bool ask(v1::RenderStreamRequest& request) {
        request.clear_settings();
        if (is_first_) {
            request.set_mode(v1::STREAM_MODE_LATEST);
            request.set_window(1);
            v1::RenderSettings& settings = *request.mutable_settings();
            settings.set_scene(scene_);
            settings.set_height(HEIGHT);
            settings.set_width(WIDTH);
        }
        request.set_acknowledged(answered_);  // the answer before was taken: there is room
        is_first_ = false;
        return call_->Write(request);
    }

    std::unique_ptr<v1::RenderService::Stub> stub_;
    std::string scene_;
    std::unique_ptr<grpc::ClientContext> context_;
    std::unique_ptr<grpc::ClientReaderWriter<v1::RenderStreamRequest, v1::Frame>> call_;
    uint64_t sequence_ = 0, answered_ = 0;
    bool is_first_ = true;
};

int largest_difference(const Bytes& one, const std::string& other) {
    if (one.size() != other.size()) throw std::runtime_error("the frames are not of one size");
    int largest = 0;
    for (size_t i = 0; i < one.size(); i++)
        largest = std::max(largest, std::abs(one[i] - static_cast<unsigned char>(other[i])));
    return largest;
}

}  // namespace

int main(int count, char** words) try {
    if (count < 4) throw std::runtime_error("usage: stream ADDRESS SCENE FRAMES [SCENE_FILE]");
    FrameStream stream(words[1], words[2]);
    std::optional<LocalFrames> here;
    if (count > 4) here.emplace(words[4], R"({"height": 128, "width": 96})");
    const int steps = std::stoi(words[3]);
    for (int step = 0; step < steps; step++) {
        Pose pose;
        pose.matrix[7] = 10.0 * step / steps;  // y
        const v1::Frame frame = stream.render(pose);
        std::cout << frame.data() << std::flush;
        std::cerr << "frame " << frame.sequence() << ", expected similarity " << frame.extrapolation().confidence();
        if (here) std::cerr << ", differs from this machine's by " << largest_difference(here->render(pose), frame.data());
        std::cerr << "\n";
    }
    return 0;
} catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 1;
}
