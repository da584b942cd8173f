// libultragray for C++: a scene and settings that free themselves, problems as exceptions.
#pragma once

#include <ultragray.h>

#include <fstream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

using Bytes = std::vector<unsigned char>;

// A pose [4, 4], row by row, mm.
struct Pose {
    double matrix[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
};

// Frames of one scene with the same settings. Several threads may render at the same time.
class LocalFrames {
 public:
    // Of a scene file, with settings as JSON. Throws std::runtime_error, in a sentence.
    LocalFrames(const std::string& path, const std::string& settings) {
        std::ifstream file(path, std::ios::binary);
        if (!file) throw std::runtime_error(path + " cannot be read");
        const Bytes bytes{std::istreambuf_iterator<char>(file), {}};
        const std::unique_ptr<ultragray_scene, decltype(&ultragray_free_scene)> scene(
            ultragray_load(bytes.data(), bytes.size()), &ultragray_free_scene);
        if (scene) view_.reset(ultragray_prepare(scene.get(), settings.c_str()));  // it outlives its scene
        if (!view_) throw std::runtime_error(ultragray_problem());
    }

    // The bytes of the outputs, one after another. Throws std::runtime_error.
    Bytes render(const Pose& pose) const {
        Bytes pixels(ultragray_frame_bytes(view_.get()));
        if (ultragray_render(view_.get(), pose.matrix, 1, 1, pixels.data(), nullptr) != 0)
            throw std::runtime_error(ultragray_problem());
        return pixels;
    }

 private:
    struct Free {
        void operator()(ultragray_view* view) const { ultragray_free_view(view); }
    };
    std::unique_ptr<ultragray_view, Free> view_;
};
