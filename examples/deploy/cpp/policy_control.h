// Runs an exported policy on what a robot measures: measurement to observation, to action, to targets of joints.
#pragma once

#include <functional>

#include "commands.h"
#include "network.h"
#include "robot_link.h"
#include "stages.h"

namespace ksim {

// The columns of an action that are targets of joints.
struct JointAction {
  JointAction(const Json& spec, const Joints& joints) : kind(spec["kind"].text()) {
    if (kind == "ctrl") {
      throw std::runtime_error("export.json: the action '" + spec["name"].text() +
                               "' writes controls of a model's actuators, which a robot does not have: train with "
                               "actions of joints");
    }
    if (kind != "pos" && kind != "vel" && kind != "effort") throw std::runtime_error(spec.place + ": kind " + kind);
    places = joints.columns(spec["names"].texts());
    first = spec["columns"].list().at(0).count();
    last = spec["columns"].list().at(1).count();
    const Json* velocity = spec.find("velocity");
    has_velocity = velocity != nullptr && !velocity->is_null();
    if (last != first + places.size() * (has_velocity ? 2 : 1)) throw std::runtime_error(spec.place + ": its columns");
    shape.emplace(spec, places.size());
    if (has_velocity) velocity_shape.emplace(*velocity, places.size());
    low = spec["limits"].list().at(0).spread(places.size());
    high = spec["limits"].list().at(1).spread(places.size());
    is_relative = spec["relative"].boolean();
  }

  void reset() {
    shape->reset();
    if (velocity_shape) velocity_shape->reset();
  }

  std::string kind;
  std::vector<size_t> places;
  size_t first = 0;
  size_t last = 0;
  bool has_velocity = false;  // of the second half of the columns
  bool is_relative = false;   // to the encoders
  std::optional<Shape> shape;
  std::optional<Shape> velocity_shape;
  Numbers low;
  Numbers high;
};

// An exported policy, its observations and its actions, for one robot.
class PolicyControl {
 public:
  PolicyControl(const std::string& folder, const Json& meta) : joints(meta) {
    const Json* pictures = meta.find("pictures");
    if (pictures != nullptr && !pictures->list().empty()) {
      throw std::runtime_error("export.json: the policy sees: this loop reads no cameras, loop.py does");
    }
    step_dt = meta["step_dt"].number();
    if (!(step_dt > 0.0 && step_dt <= 3600.0)) throw std::runtime_error("export.json: step_dt " + text("%g", step_dt));
    num_actions_ = meta["policy"]["num_actions"].count();
    for (const auto& [name, spec] : meta["commands"].members()) commands.emplace_back(name, spec);
    for (const auto& spec : meta["observations"].list()) terms_.emplace_back(spec);
    const Json& obs = meta["obs"];
    observe_ = std::make_unique<Network>(folder + "/obs.onnx", obs["states"], obs["output"].text());
    for (const auto& node : obs["measurements"].list()) sources_[node["input"].text()] = source_of(node);
    policy_ = std::make_unique<Network>(folder + "/policy.onnx", meta["policy"]["states"], "actions");
    for (const auto& spec : meta["actions"].list()) actions_.emplace_back(spec, joints);
    for (const auto& spec : meta["action_chain"].list()) {
      auto stage = make_stage(spec, num_actions_);
      if (stage) chain_.push_back(std::move(stage));
    }
    begin();
  }

  // Begin an episode: forget states, actions and time; commands stay.
  void begin() {
    steps_ = 0;
    action_.assign(num_actions_, 0.0);
    last_action_ = action_;
    const Numbers still(joints.size(), 0.0);
    targets_ = {{"pos", joints.default_pos}, {"vel", still}, {"effort", still}};
    observe_->reset();
    policy_->reset();
    for (auto& stage : chain_) stage->reset();
    for (auto& action : actions_) action.reset();
  }

  // The inputs of obs.onnx that a robot's measurements do not give.
  Names lacking(const Measurement& measurement) const {
    Names found;
    for (const auto& name : estimated_) {
      if (measurement.estimates.count(name) == 0) found.push_back(name);
    }
    if (needs_ang_vel_ && !measurement.root_ang_vel) found.push_back("root_ang_vel");
    if (needs_quat_ && !measurement.root_quat) found.push_back("root_quat");
    return found;
  }

  // Run one step of the policy, and return what it asks of the motors.
  JointCommand operator()(const Measurement& measurement) {
    Values given;
    for (const auto& [name, source] : sources_) given[name] = source(measurement);
    const Numbers raw = observe_->run(given);
    observe_->advance();
    Numbers action = policy_->run({{"obs", frame_of(raw)}});
    policy_->advance();
    for (auto& stage : chain_) action = (*stage)(action);
    last_action_ = action_;
    action_ = action;
    for (auto& one : actions_) aim(one, measurement);
    ++steps_;
    Numbers effort = targets_["effort"];
    for (size_t k = 0; k < effort.size(); ++k) effort[k] *= joints.effort_scale[k];
    return {targets_["pos"], targets_["vel"], effort, joints.stiffness, joints.damping};
  }

  Joints joints;
  std::vector<Command> commands;
  double step_dt = 0.0;

 private:
  using Source = std::function<Numbers(const Measurement&)>;

  // What happens to the raw values of a term, without its noise and delay.
  struct Term {
    explicit Term(const Json& spec) : size(spec["size"].count()), scale(spec["scale"].spread(size)) {
      low = spec["clip"].list().at(0).number_or(-infinity);
      high = spec["clip"].list().at(1).number_or(infinity);
    }

    size_t size;
    Numbers scale;
    double low;
    double high;
  };

  Numbers frame_of(const Numbers& raw) const {
    Numbers frame;
    for (const auto& term : terms_) {
      for (size_t k = 0; k < term.size; ++k) {
        frame.push_back(clipped(raw.at(frame.size()), term.low, term.high) * term.scale[k]);
      }
    }
    return frame;
  }

  // Make targets of an action's columns.
  void aim(JointAction& one, const Measurement& measurement) {
    if (action_.size() < one.last) throw std::runtime_error("the policy gives too few actions");
    const auto begin = action_.begin() + static_cast<long>(one.first);
    const auto middle = begin + static_cast<long>(one.places.size());
    Numbers value = (*one.shape)(Numbers(begin, middle));
    for (size_t k = 0; k < value.size(); ++k) {
      const double shift = one.is_relative ? measurement.joint_pos[one.places[k]] : 0.0;
      targets_[one.kind][one.places[k]] = clipped(value[k] + shift, one.low[k], one.high[k]);
    }
    if (!one.has_velocity) return;
    const Numbers speed = (*one.velocity_shape)(Numbers(middle, action_.begin() + static_cast<long>(one.last)));
    for (size_t k = 0; k < speed.size(); ++k) targets_["vel"][one.places[k]] = speed[k];
  }

  // Returns what fills an input of obs.onnx: what is none of the loop's own is an estimate of the robot.
  Source source_of(const Json& node) {
    const std::string& quantity = node["quantity"].text();
    if (quantity.rfind("joint_", 0) == 0 && node.find("joints") != nullptr) return of_joints(quantity, node);
    if (quantity == "default_joint_pos") {
      const Numbers pose = picked(joints.default_pos, joints.columns(node["joints"].texts()));
      return [pose](const Measurement&) { return pose; };
    }
    // Readings of a robot have it in them.
    if (quantity == "encoder_bias") return constant(node["joints"].list().size());
    if (quantity == "time_out_offset" || quantity == "terminated") return constant(1);
    if (quantity == "command") return of_command(node["command"].text());
    if (quantity == "action") return [this](const Measurement&) { return action_; };
    if (quantity == "last_action") return [this](const Measurement&) { return last_action_; };
    if (quantity == "step") return [this](const Measurement&) { return Numbers{static_cast<double>(steps_)}; };
    if (quantity == "time") return [this](const Measurement&) { return Numbers{static_cast<double>(steps_) * step_dt}; };
    if (quantity == "root_quat" || quantity == "projected_gravity" || quantity == "root_ang_vel") {
      return of_root(quantity, node);
    }
    return estimate(node);
  }

  static Source constant(size_t size) {
    return [size](const Measurement&) { return Numbers(size, 0.0); };
  }

  Source estimate(const Json& node) {
    const std::string name = node["input"].text();
    estimated_.push_back(name);
    return [name](const Measurement& measured) { return measured.estimates.at(name); };
  }

  Source of_joints(const std::string& quantity, const Json& node) {
    const std::vector<size_t> places = joints.columns(node["joints"].texts());
    if (quantity == "joint_pos") return [places](const Measurement& m) { return picked(m.joint_pos, places); };
    if (quantity == "joint_vel") return [places](const Measurement& m) { return picked(m.joint_vel, places); };
    if (quantity == "joint_effort") return [places](const Measurement& m) { return picked(m.joint_effort, places); };
    if (quantity == "joint_pos_rel") {
      const Numbers pose = picked(joints.default_pos, places);
      return [places, pose](const Measurement& measured) {
        Numbers found = picked(measured.joint_pos, places);
        for (size_t k = 0; k < found.size(); ++k) found[k] -= pose[k];
        return found;
      };
    }
    for (const char* kind : {"pos", "vel", "effort"}) {
      if (quantity != text("joint_%s_target", kind)) continue;
      return [this, places, kind](const Measurement&) { return picked(targets_.at(kind), places); };
    }
    return estimate(node);
  }

  Source of_command(const std::string& name) {
    for (size_t k = 0; k < commands.size(); ++k) {
      // Whatever a stick says, the policy reads what it has seen.
      if (commands[k].name == name) return [this, k](const Measurement&) { return commands[k].clip(commands[k].values); };
    }
    throw std::runtime_error("export.json: there is no command " + name);
  }

  Source of_root(const std::string& quantity, const Json& node) {
    const Json* frame = node.find("frame");
    const bool is_of_world = frame != nullptr && !frame->is_null() && frame->text() != "root";
    needs_ang_vel_ |= quantity == "root_ang_vel";
    needs_quat_ |= quantity != "root_ang_vel" || is_of_world;
    if (quantity == "root_quat") return [](const Measurement& measured) { return measured.root_quat.value(); };
    if (quantity == "projected_gravity") {
      return [](const Measurement& measured) { return as_numbers(to_root_axes(measured.root_quat.value(), down)); };
    }
    if (!is_of_world) return [](const Measurement& measured) { return measured.root_ang_vel.value(); };
    return [](const Measurement& measured) {
      const Numbers& turning = measured.root_ang_vel.value();
      return as_numbers(to_world_axes(measured.root_quat.value(), {turning[0], turning[1], turning[2]}));
    };
  }

  static Numbers as_numbers(const Vector3& vector) { return {vector.begin(), vector.end()}; }

  static Numbers picked(const Numbers& values, const std::vector<size_t>& places) {
    Numbers found;
    for (size_t place : places) found.push_back(values[place]);
    return found;
  }

  size_t num_actions_ = 0;
  size_t steps_ = 0;
  Numbers action_;
  Numbers last_action_;
  std::map<std::string, Numbers> targets_;
  std::unique_ptr<Network> observe_;
  std::unique_ptr<Network> policy_;
  std::map<std::string, Source> sources_;
  std::vector<Term> terms_;
  std::vector<std::unique_ptr<Stage>> chain_;
  std::vector<JointAction> actions_;
  Names estimated_;
  bool needs_quat_ = false;
  bool needs_ang_vel_ = false;
};

}  // namespace ksim
