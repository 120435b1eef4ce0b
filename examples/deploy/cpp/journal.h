// Writes what a loop did, in the form that `ksim-rl identify` reads, from a thread of its own.
#pragma once

#include <condition_variable>
#include <deque>
#include <fstream>
#include <iostream>
#include <mutex>
#include <thread>

#include <sys/stat.h>

#include "states.h"

namespace ksim {

// A table of all periods as CSV, and a line with # in front for each event, which is shown, too. Columns are as in
// loop.py. Nothing here waits for the disk: what it cannot take is dropped, and counted in `lost`.
class Journal {
 public:
  Journal(const std::string& path, const Joints& joints) : size_(joints.size()) {
    struct stat found {};
    // The log of an earlier run is never written over.
    if (stat(path.c_str(), &found) == 0) throw std::runtime_error("--log " + path + ": there is one already");
    file_.open(path);
    if (!file_) throw std::runtime_error("--log " + path + " cannot be written");
    file_ << "time,state,message_age";
    for (const char* what : {"projected_gravity", "root_ang_vel"}) {
      for (const char* axis : {"x", "y", "z"}) file_ << "," << what << "." << axis;
    }
    for (const auto& name : joints.names) {
      for (const char* column : columns) file_ << "," << name << "." << column;
    }
    file_ << "\n";
    thread_ = std::thread([this] { write(); });
  }

  ~Journal() { close(); }

  // Log a period; without a measurement the readings are NaN.
  void period(double now, State state, const std::optional<Measurement>& measurement, const JointCommand& command,
              const std::optional<JointCommand>& asked) {
    std::string line = text("%.6f,%d", since(now), static_cast<int>(state));
    add(line, measurement ? now - measurement->stamp : std::nan(""));
    add_root(line, measurement);
    const Numbers unread(size_, std::nan(""));
    const Numbers* of_joints[] = {
        measurement ? &measurement->joint_pos : &unread,
        measurement ? &measurement->joint_vel : &unread,
        measurement ? &measurement->joint_effort : &unread,
        &command.pos,
        &command.vel,
        &command.effort,
        &command.stiffness,
        &command.damping,
        asked ? &asked->pos : &unread,
        asked ? &asked->vel : &unread,
        asked ? &asked->effort : &unread,
    };
    for (size_t k = 0; k < size_; ++k) {
      // A message may have too few numbers, which is a fault, and logged all the same.
      for (const Numbers* values : of_joints) add(line, k < values->size() ? (*values)[k] : std::nan(""));
    }
    put(line + "\n");
  }

  // Log a line of text, and show it.
  void event(double now, const std::string& what) { put(text("# %.3f s: ", since(now)) + what + "\n"); }

  // Write what waits.
  void close() {
    if (!thread_.joinable()) return;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      is_over_ = true;
    }
    wake_.notify_one();
    thread_.join();
  }

  long lost = 0;
  bool is_torn = false;  // the disk did not take all of it; known once it is closed

 private:
  static constexpr size_t most_waiting = 1000;
  static constexpr const char* columns[] = {"position",      "velocity",        "effort",     "target_position",
                                            "target_velocity", "target_effort", "stiffness",  "damping",
                                            "dry_position",  "dry_velocity",    "dry_effort"};

  double since(double now) {
    if (std::isnan(started_)) started_ = now;
    return now - started_;
  }

  static void add(std::string& line, double value) {
    // As Python writes it, whatever its sign.
    line += std::isnan(value) ? ",nan" : text(",%.9g", value);
  }

  static void add_root(std::string& line, const std::optional<Measurement>& measurement) {
    Vector3 gravity = {std::nan(""), std::nan(""), std::nan("")};
    Vector3 turning = gravity;
    if (measurement && measurement->root_quat && measurement->root_quat->size() == 4) {
      gravity = to_root_axes(*measurement->root_quat, down);
    }
    if (measurement && measurement->root_ang_vel && measurement->root_ang_vel->size() == 3) {
      std::copy(measurement->root_ang_vel->begin(), measurement->root_ang_vel->end(), turning.begin());
    }
    for (double value : gravity) add(line, value);
    for (double value : turning) add(line, value);
  }

  void put(std::string line) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (waiting_.size() >= most_waiting) {
        ++lost;
        return;
      }
      waiting_.push_back(std::move(line));
    }
    wake_.notify_one();
  }

  void write() {
    while (true) {
      std::deque<std::string> lines;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [this] { return is_over_ || !waiting_.empty(); });
        lines.swap(waiting_);
        if (lines.empty()) break;
      }
      for (const auto& line : lines) {
        file_ << line;
        if (line[0] == '#') std::cout << line.substr(2) << std::flush;
      }
    }
    is_torn = !file_.flush();
  }

  size_t size_;
  double started_ = std::nan("");
  std::ofstream file_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<std::string> waiting_;
  bool is_over_ = false;
  std::thread thread_;
};

}  // namespace ksim
