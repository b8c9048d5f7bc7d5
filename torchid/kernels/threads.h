// Work on samples in threads, each on whole groups of its own: results do not depend on how many threads there are.
#pragma once
#include <algorithm>
#include <cstdint>
#include <system_error>
#include <thread>
#include <vector>

// Call work(begin, end) for samples [0, samples), cut at multiples of `step`.
template <class Work> void in_threads(int64_t samples, int64_t step, int64_t threads, const Work &work) {
    const int64_t groups = (samples + step - 1) / step;
    const int64_t parts = std::max<int64_t>(1, std::min(threads, groups / 8)); // a thread takes 20 us to start
    const auto part = [&](int64_t k) {
        work(groups * k / parts * step, std::min(samples, groups * (k + 1) / parts * step));
    };
    std::vector<std::thread> others;
    for (int64_t k = 1; k < parts; ++k) {
        try {
            others.emplace_back(part, k);
        } catch (const std::system_error &) { // no more threads are allowed
            part(k);
        }
    }
    part(0);
    for (auto &other : others) other.join();
}
