// A scene file in memory: the safetensors bundle that ultragray.scene.info describes.
#pragma once

#include <memory>
#include <vector>

#include "../kernels/scene.hpp"
#include "confidence.hpp"

namespace ultragray::library {

// What a scene file says of itself: the fields of SceneInfo that a frame depends on.
struct SceneInfo {
    Vector centre_mm{};
    std::optional<Probe> probe;
    int height = 512, width = 512;  // of the training images
    Intensity intensity = Intensity::Released;
    int sh_degree = 0;
    int64_t gaussian_count = 0;
    std::vector<std::pair<int, std::string>> label_names;
    std::optional<ElevationBeam> beam;
    std::optional<SpeckleModel> speckle;
    std::optional<ConfidenceModel> confidence;
    std::optional<Vector> tissue_shares;
    std::string json;  // all of it, as the file has it
};

// How much of a file is at hand: of the beginning of a compressed one, those parts are read that it holds.
enum class Extent { Whole, Beginning };

// A scene, ready to be drawn.
struct Scene {
    SceneInfo info;
    std::unique_ptr<PreparedScene> gaussians;
    std::vector<std::pair<int, std::unique_ptr<PreparedScene>>> parts;  // those of each label that occurs, 0 too
    std::vector<Pose> training_poses, rest_poses, errors;               // [P] each, or none

    // Copies what it needs. Throws Fault: what is wrong with the file, in a sentence.
    static Scene read(const void* bytes, size_t size, Extent extent);
};

}  // namespace ultragray::library
