#include "threads.hpp"

#include <pthread.h>
#include <sched.h>

#include <algorithm>
#include <exception>
#include <iterator>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace ultragray {

namespace {

// Starts a thread on another processor than the caller's. Left alone, the scheduler of a virtual machine takes a processor
// that sleeps for one that is busy, and starts a helper where the caller keeps it waiting for milliseconds.
std::thread start_elsewhere(const std::function<void()>& work) {
#ifdef __linux__
    cpu_set_t anywhere;
    const int here = sched_getcpu();
    if (here >= 0 && here < CPU_SETSIZE && sched_getaffinity(0, sizeof anywhere, &anywhere) == 0) {
        cpu_set_t elsewhere = anywhere;
        CPU_CLR(here, &elsewhere);
        std::thread helper(work);
        if (CPU_COUNT(&elsewhere) > 0) pthread_setaffinity_np(helper.native_handle(), sizeof elsewhere, &elsewhere);
        return helper;
    }
#endif
    return std::thread(work);
}

}  // namespace

void run_phases(std::initializer_list<Phase*> phases, int threads) {
    std::exception_ptr failure;
    std::mutex failure_lock;
    std::atomic<bool> failed{false};
    const auto take_all = [&](Phase& phase) {
        for (int i = phase.next++; i < phase.count; i = phase.next++) {
            try {
                if (!failed) phase.task(i);
            } catch (...) {
                const std::lock_guard<std::mutex> guard(failure_lock);
                if (!failure) failure = std::current_exception();
                failed = true;
            }
            ++phase.done;
        }
    };
    const auto work = [&] {
        for (Phase* phase : phases) {
            take_all(*phase);
            if (phase == *std::prev(phases.end())) return;
            while (phase->done < phase->count) std::this_thread::yield();
        }
    };
    int most = 0;
    for (const Phase* phase : phases) most = std::max(most, phase->count);
    std::vector<std::thread> helpers;
    const int wanted = std::min(threads, most) - 1;
    helpers.reserve(std::max(0, wanted));
    try {
        for (int t = 0; t < wanted; ++t) helpers.push_back(start_elsewhere(work));
    } catch (const std::system_error&) {
        // No more threads to be had: those that run do the work.
    }
    work();
    for (std::thread& helper : helpers) helper.join();
    if (failure) std::rethrow_exception(failure);
}

void run_ranges(int64_t count, const std::function<void(int64_t, int64_t)>& task, int threads) {
    constexpr int64_t kRange = 8192;
    Phase ranges{static_cast<int>((count + kRange - 1) / kRange),
                 [&](int i) { task(i * kRange, std::min((i + 1) * kRange, count)); }};
    run_phases({&ranges}, threads);
}

}  // namespace ultragray
