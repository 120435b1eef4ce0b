// This program runs an exported policy at its own rate on onnxruntime's C++ interface, with limits.
//
//   g++ -std=c++17 -O2 loop.cpp -I<onnxruntime>/include -L<onnxruntime>/lib -lonnxruntime -o loop
//   ./loop RUN/export/policy.onnx
//
// `read_robot` and `write_robot` are yours to write: names, order, units, scales and noise of what goes in and out stand
// in export.json, and the most important ones in the ONNX file's own metadata, which is read here. Read docs/deploy.md.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

using Numbers = std::vector<float>;
using Names = std::vector<std::string>;

struct Limits {
  float most_tilt = 0.87f;     // rad, of the root's z axis from the vertical
  float most_change = 0.5f;    // rad, of a joint target in one step
  float most_target = 3.0f;    // rad, of a joint target from the default pose
};

struct Reading {
  Numbers obs;      // the terms of `observation_names`, side by side: obs.onnx gives them, then clip and scale
  float tilt = 0.0f;
};

// Fill in: the observations of your robot. Here it stands still and upright.
Reading read_robot(size_t size) { return {Numbers(size, 0.0f), 0.0f}; }

// Fill in: position targets, rad, of the joints `names`. Send them by name: your bus has an order of its own.
void write_robot(const Names&, const Numbers& targets) {
  if (targets.empty()) throw std::runtime_error("no targets");
}

// Fill in: let the motors hold the present pose with low gains and high damping.
void hold_softly() {}

Names split(const std::string& text) {
  Names parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, ',');) parts.push_back(part);
  return parts;
}

Numbers numbers(const std::string& text) {
  Numbers values;
  for (const auto& part : split(text)) values.push_back(std::stof(part));
  return values;
}

class Policy {
 public:
  explicit Policy(const char* path) : session_(env_, path, options()) {
    Ort::AllocatorWithDefaultOptions allocator;
    for (size_t i = 0; i < session_.GetInputCount(); ++i) {
      inputs_.push_back(session_.GetInputNameAllocated(i, allocator).get());
      auto shape = session_.GetInputTypeInfo(i).GetTensorTypeAndShapeInfo().GetShape();
      shape[0] = 1;  // one robot
      size_t size = 1;
      for (auto edge : shape) size *= static_cast<size_t>(edge);
      shapes_.push_back(shape);
      values_.emplace_back(size, 0.0f);
    }
    for (size_t i = 0; i < session_.GetOutputCount(); ++i)
      outputs_.push_back(session_.GetOutputNameAllocated(i, allocator).get());
    if (inputs_.size() != outputs_.size()) throw std::runtime_error("states and next states do not pair");
    auto metadata = session_.GetModelMetadata();
    for (auto& key : metadata.GetCustomMetadataMapKeysAllocated(allocator))
      metadata_[key.get()] = metadata.LookupCustomMetadataMapAllocated(key.get(), allocator).get();
  }

  const std::string& text(const std::string& key) const {
    auto found = metadata_.find(key);
    if (found == metadata_.end()) throw std::runtime_error("policy.onnx says nothing about " + key);
    return found->second;
  }

  size_t obs_size() const { return values_[0].size(); }

  // Memory starts with zeros. Histories, `history_<term>_in`, start with the first frame in all places:
  // `columns` says where each of them stands in obs (policy.states in export.json).
  void reset(const Numbers& obs, const std::map<std::string, std::pair<size_t, size_t>>& columns) {
    for (size_t i = 1; i < values_.size(); ++i) {
      std::fill(values_[i].begin(), values_[i].end(), 0.0f);
      auto found = columns.find(inputs_[i]);
      if (found == columns.end()) continue;
      auto [start, stop] = found->second;
      for (size_t k = 0; k < values_[i].size(); ++k) values_[i][k] = obs.at(start + k % (stop - start));
    }
  }

  Numbers act(const Numbers& obs) {
    if (obs.size() != values_[0].size()) throw std::runtime_error("obs has another size than the policy reads");
    values_[0] = obs;
    auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    std::vector<Ort::Value> given;
    for (size_t i = 0; i < values_.size(); ++i)
      given.push_back(Ort::Value::CreateTensor<float>(memory, values_[i].data(), values_[i].size(),
                                                      shapes_[i].data(), shapes_[i].size()));
    std::vector<const char*> in, out;
    for (const auto& name : inputs_) in.push_back(name.c_str());
    for (const auto& name : outputs_) out.push_back(name.c_str());
    auto found = session_.Run(Ort::RunOptions{nullptr}, in.data(), given.data(), in.size(), out.data(), out.size());
    for (size_t i = 1; i < found.size(); ++i) {
      const float* next = found[i].GetTensorData<float>();
      values_[i].assign(next, next + values_[i].size());  // each state's output feeds the input at its place
    }
    const float* actions = found[0].GetTensorData<float>();
    return Numbers(actions, actions + found[0].GetTensorTypeAndShapeInfo().GetElementCount());
  }

 private:
  static Ort::SessionOptions options() {
    Ort::SessionOptions chosen;
    chosen.SetIntraOpNumThreads(1);
    return chosen;
  }

  Ort::Env env_{ORT_LOGGING_LEVEL_WARNING, "policy"};
  Ort::Session session_;
  Names inputs_, outputs_;
  std::vector<std::vector<int64_t>> shapes_;
  std::vector<Numbers> values_;
  std::map<std::string, std::string> metadata_;
};

int main(int count, char** arguments) try {
  if (count < 2) throw std::runtime_error("usage: loop policy.onnx [seconds]");
  Policy policy(arguments[1]);
  const double seconds = count > 2 ? std::atof(arguments[2]) : 10.0;
  const auto joints = split(policy.text("joint_names"));
  const auto pose = numbers(policy.text("default_joint_pos"));
  const auto scale = numbers(policy.text("action_scale"));
  const double step = std::stod(policy.text("step_dt"));
  if (pose.size() != joints.size() || scale.size() != joints.size())
    throw std::runtime_error("this loop is for policies whose actions are joint positions alone");

  const Limits limits;
  Numbers targets = pose;
  policy.reset(read_robot(policy.obs_size()).obs, {});
  const auto period = std::chrono::duration_cast<std::chrono::steady_clock::duration>(std::chrono::duration<double>(step));
  auto due = std::chrono::steady_clock::now();
  for (long i = 0; i < std::lround(seconds / step); ++i) {
    const Reading reading = read_robot(policy.obs_size());
    if (!(reading.tilt <= limits.most_tilt)) throw std::runtime_error("tilted too far");
    const Numbers actions = policy.act(reading.obs);
    for (size_t k = 0; k < joints.size(); ++k) {
      if (!std::isfinite(actions[k])) throw std::runtime_error("no finite action for " + joints[k]);
      float wanted = pose[k] + scale[k] * actions[k];
      wanted = std::clamp(wanted, targets[k] - limits.most_change, targets[k] + limits.most_change);
      targets[k] = std::clamp(wanted, pose[k] - limits.most_target, pose[k] + limits.most_target);
    }
    write_robot(joints, targets);
    due += period;
    if (std::chrono::steady_clock::now() > due + period) throw std::runtime_error("a step came a whole period late");
    std::this_thread::sleep_until(due);
  }
  std::printf("%g s at %g Hz\n", seconds, 1.0 / step);
  return 0;
} catch (const std::exception& error) {
  hold_softly();
  std::fprintf(stderr, "stopped: %s\n", error.what());
  return 1;
}
