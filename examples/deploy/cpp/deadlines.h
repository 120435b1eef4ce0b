// Keeps a loop's rate by deadlines, and tells how far off it was.
#pragma once

#include <cerrno>
#include <cmath>
#include <ctime>
#include <fstream>
#include <vector>

#include <unistd.h>

#include "text.h"

namespace ksim {

// The computer's clock, which no change of the time of day moves.
struct Clock {
  static double now() {
    timespec time{};
    clock_gettime(CLOCK_MONOTONIC, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
  }

  // Returns at a time, or at once where it has passed.
  static void sleep_until(double deadline) {
    timespec time{};
    time.tv_sec = static_cast<time_t>(deadline);
    time.tv_nsec = static_cast<long>(1e9 * (deadline - static_cast<double>(time.tv_sec)));
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, nullptr) == EINTR) {
    }
  }
};

// How often durations were how long, in memory that does not grow.
class Durations {
 public:
  Durations() : counts_(most_bins, 0) {}

  // Counts one duration; those beyond the last bin are counted in it.
  void add(double seconds) {
    const double place = std::min(std::max(seconds / resolution, 0.0), static_cast<double>(most_bins - 1));
    ++counts_[static_cast<size_t>(place)];
    ++total_;
    longest = std::max(longest, seconds);
  }

  // The duration that a share of all did not exceed, to the resolution; NaN where there are none.
  double quantile(double share) const {
    if (total_ == 0) return std::nan("");
    long sum = 0;
    size_t place = 0;
    for (; place < most_bins; ++place) {
      sum += counts_[place];
      if (static_cast<double>(sum) >= share * static_cast<double>(total_)) break;
    }
    return std::min(static_cast<double>(place + 1) * resolution, longest);
  }

  double longest = 0.0;

 private:
  static constexpr double resolution = 1e-5;
  static constexpr size_t most_bins = 10000;
  std::vector<long> counts_;
  long total_ = 0;
};

// The memory of this process, MiB; NaN where the system does not tell.
inline double resident_mib() {
  std::ifstream file("/proc/self/statm");
  double pages = std::nan("");
  file >> pages >> pages;
  return pages * static_cast<double>(sysconf(_SC_PAGESIZE)) / (1 << 20);
}

// How punctual a loop was. A period begins at its deadline: `woken` is how late the loop ran then, which is the
// scheduler's; `own` is the time from there until the command was handed to the robot, which is the loop's.
struct Punctuality {
  void add(double deadline, double began, double sent) {
    ++periods;
    woken.add(began - deadline);
    own.add(sent - began);
    late.add(sent - deadline);
    // Once all has been used.
    if (periods == 500) memory_early = resident_mib();
  }

  Durations woken;
  Durations own;
  Durations late;
  long periods = 0;
  long missed = 0;
  double memory_early = std::nan("");
};

// Returns the first deadline after `now` on the grid of a deadline, and adds those that were missed on the way.
inline double next_deadline(double deadline, double period, double now, long& missed) {
  const double following = deadline + period;
  if (now <= following) return following;
  const double behind = std::ceil((now - following) / period);
  missed += static_cast<long>(behind);
  return following + behind * period;
}

}  // namespace ksim
