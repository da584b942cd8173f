// Work shared out over threads.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <initializer_list>

namespace ultragray {

// Tasks 0 … count − 1, taken by several threads.
struct Phase {
    int count;
    std::function<void(int)> task;
    std::atomic<int> next{0}, done{0};
};

// Runs all tasks of each phase, one phase after another, on up to `threads` threads, the caller's among them: one start of
// threads for all, because that costs as much as a tenth of a small frame. The first exception is rethrown; tasks that have
// not begun by then are left out.
void run_phases(std::initializer_list<Phase*> phases, int threads);

// Runs `task` on slices [begin, end) of 0 … count − 1.
void run_ranges(int64_t count, const std::function<void(int64_t, int64_t)>& task, int threads);

}  // namespace ultragray
