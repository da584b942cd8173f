// sweep SCENE FRAMES: so many frames of a scene file along 10 mm of elevation, one after another to the standard output, in
// C++.
#include <iostream>

#include "local_frames.hpp"

int main(int count, char** words) try {
    if (count != 3) throw std::runtime_error("usage: sweep SCENE FRAMES");
    const LocalFrames frames(words[1], R"({"height": 128, "width": 96})");
    const int steps = std::stoi(words[2]);
    for (int step = 0; step < steps; step++) {
        Pose pose;
        pose.matrix[7] = 10.0 * step / steps;  // y
        const Bytes pixels = frames.render(pose);
        std::cout.write(reinterpret_cast<const char*>(pixels.data()), static_cast<std::streamsize>(pixels.size()));
    }
    return 0;
} catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 1;
}
