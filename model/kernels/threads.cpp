#include "threads.hpp"

#include <pthread.h>
#include <sched.h>

#include <algorithm>
#include <exception>
#include <iterator>
#include <mutex>
#include <thread>
#include <vector>

namespace ultragray {

namespace {

void* call(void* work) {
    (*static_cast<const std::function<void()>*>(work))();
    return nullptr;
}

// Starts a thread, on another processor than the caller's where there is one: left alone, the scheduler of a virtual machine
// may queue it behind its caller for milliseconds, while another processor sleeps. The processor is chosen as the thread is
// made: given to one that has ended, an affinity would fall on the caller. False where no more threads are to be had.
bool start_elsewhere(const std::function<void()>& work, pthread_t& helper) {
    void* const argument = const_cast<std::function<void()>*>(&work);
#ifdef __GLIBC__
    cpu_set_t processors;
    const int here = sched_getcpu();
    if (here >= 0 && here < CPU_SETSIZE && sched_getaffinity(0, sizeof processors, &processors) == 0) {
        CPU_CLR(here, &processors);
        pthread_attr_t elsewhere;
        pthread_attr_init(&elsewhere);
        const bool started = CPU_COUNT(&processors) > 0 &&
                             pthread_attr_setaffinity_np(&elsewhere, sizeof processors, &processors) == 0 &&
                             pthread_create(&helper, &elsewhere, call, argument) == 0;
        pthread_attr_destroy(&elsewhere);
        if (started) return true;
    }
#endif
    return pthread_create(&helper, nullptr, call, argument) == 0;
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
    const std::function<void()> work = [&] {
        for (Phase* phase : phases) {
            take_all(*phase);
            if (phase == *std::prev(phases.end())) return;
            while (phase->done < phase->count) std::this_thread::yield();
        }
    };
    int most = 0;
    for (const Phase* phase : phases) most = std::max(most, phase->count);
    std::vector<pthread_t> helpers(std::max(0, std::min(threads, most) - 1));
    size_t started = 0;
    while (started < helpers.size() && start_elsewhere(work, helpers[started])) ++started;
    work();
    for (size_t t = 0; t < started; ++t) pthread_join(helpers[t], nullptr);
    if (failure) std::rethrow_exception(failure);
}

void run_ranges(int64_t count, const std::function<void(int64_t, int64_t)>& task, int threads) {
    constexpr int64_t kRange = 8192;
    Phase ranges{static_cast<int>((count + kRange - 1) / kRange),
                 [&](int i) { task(i * kRange, std::min((i + 1) * kRange, count)); }};
    run_phases({&ranges}, threads);
}

}  // namespace ultragray
