// What becomes of readings and actions on their way: clips, scales, filters, targets of joints.
#pragma once

#include <memory>
#include <optional>

#include "joints.h"

namespace ksim {

// A change of numbers, which may keep memory until `reset`.
class Stage {
 public:
  virtual ~Stage() = default;
  virtual Numbers operator()(const Numbers& value) = 0;
  virtual void reset() {}
};

inline double clipped(double value, double low, double high) { return std::min(std::max(value, low), high); }

class Clip : public Stage {
 public:
  Clip(double low, double high) : low_(low), high_(high) {}

  Numbers operator()(const Numbers& value) override {
    Numbers found = value;
    for (double& number : found) number = clipped(number, low_, high_);
    return found;
  }

 private:
  double low_;
  double high_;
};

// Multiplies, and adds then.
class Scale : public Stage {
 public:
  Scale(const Json& scale, const Json& offset, size_t size) : scale_(scale.spread(size)), offset_(offset.spread(size)) {}

  Numbers operator()(const Numbers& value) override {
    Numbers found = value;
    for (size_t k = 0; k < found.size(); ++k) found[k] = found[k] * scale_[k] + offset_[k];
    return found;
  }

 private:
  Numbers scale_;
  Numbers offset_;
};

// A first-order filter; without `initial` it starts at the first value of an episode.
class LowPass : public Stage {
 public:
  LowPass(double alpha, std::optional<double> initial) : alpha_(alpha), initial_(initial) {}

  void reset() override { kept_.clear(); }

  Numbers operator()(const Numbers& value) override {
    Numbers before = kept_;
    if (before.empty()) before = initial_ ? Numbers(value.size(), *initial_) : value;
    for (size_t k = 0; k < value.size(); ++k) before[k] += alpha_ * (value[k] - before[k]);
    kept_ = before;
    return kept_;
  }

 private:
  double alpha_;
  std::optional<double> initial_;
  Numbers kept_;
};

// Makes targets of an action's columns: clip, tanh, scale, filter and offset, in this order.
class Shape : public Stage {
 public:
  Shape(const Json& spec, size_t size) : scale_(spec["scale"].spread(size)), offset_(spec["offset"].spread(size)) {
    const Json& clip = spec["clip"];
    if (!clip.is_null()) {
      low_ = clip.list().at(0).number();
      high_ = clip.list().at(1).number();
    }
    uses_tanh_ = spec["tanh"].boolean();
    // The filtered value is the scaled action, and begins at 0 in each episode.
    if (!spec["alpha"].is_null()) low_pass_.emplace(spec["alpha"].number(), 0.0);
  }

  void reset() override {
    if (low_pass_) low_pass_->reset();
  }

  Numbers operator()(const Numbers& value) override {
    Numbers found = value;
    for (size_t k = 0; k < found.size(); ++k) {
      const double within = clipped(found[k], low_, high_);
      found[k] = (uses_tanh_ ? std::tanh(within) : within) * scale_[k];
    }
    if (low_pass_) found = (*low_pass_)(found);
    for (size_t k = 0; k < found.size(); ++k) found[k] += offset_[k];
    return found;
  }

 private:
  Numbers scale_;
  Numbers offset_;
  double low_ = -infinity;
  double high_ = infinity;
  bool uses_tanh_ = false;
  std::optional<LowPass> low_pass_;
};

// Returns a stage of the action chain; a delay is none, as a robot has lags of its own.
inline std::unique_ptr<Stage> make_stage(const Json& spec, size_t size) {
  const std::string& kind = spec["kind"].text();
  if (kind == "delay") return nullptr;
  if (kind == "clip") return std::make_unique<Clip>(spec["low"].number_or(-infinity), spec["high"].number_or(infinity));
  if (kind == "scale") return std::make_unique<Scale>(spec["scale"], spec["offset"], size);
  if (kind != "low_pass") throw std::runtime_error(spec.place + ": kind " + kind + " is none of this loop");
  std::optional<double> initial;
  if (!spec["initial"].is_null()) initial = spec["initial"].number();
  return std::make_unique<LowPass>(spec["alpha"].number(), initial);
}

}  // namespace ksim
