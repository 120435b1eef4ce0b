// The states of a loop: dry, damp, stand up, policy, stop; what each asks of motors, and what leads to the next.
#pragma once

#include <functional>

#include "dry_run.h"
#include "watch.h"

namespace ksim {

// Numbers stand in the log.
enum class State { damp = 0, stand = 1, policy = 2, stop = 3, dry = 4 };

inline const char* name_of(State state) {
  static const char* const names[] = {"damp", "stand", "policy", "stop", "dry"};
  return names[static_cast<int>(state)];
}

// How much of a hand-over is done: from 0 to 1, with no speed at both ends.
inline double smooth(double passed, double seconds) {
  if (passed >= seconds) return 1.0;
  const double share = passed / seconds;
  return share * share * (3.0 - 2.0 * share);
}

inline double between(double first, double last, double share) { return first + share * (last - first); }

inline Numbers between(const Numbers& first, const Numbers& last, double share) {
  Numbers found = first;
  for (size_t k = 0; k < found.size(); ++k) found[k] = between(first[k], last[k], share);
  return found;
}

// Gives a command of joints for each measurement, and ends in damped motors whatever happens.
class StateMachine {
 public:
  // Gets a line for each transition, with the time.
  using Note = std::function<void(double, const std::string&)>;

  StateMachine(PolicyControl& control_, DryRun& dry_, double period, const Limits& limits, const Times& times, Note note_)
      : control(control_),
        dry(dry_),
        watch(control_.joints, limits, period),
        effort_limit(control_.joints, limits.effort_share),
        note(std::move(note_)),
        joints_(control_.joints),
        times_(times),
        pose_(joints_.default_pos),
        first_pose_(pose_) {
    for (size_t k = 0; k < joints_.size(); ++k) {
      braking_.push_back(joints_.driven[k] ? times_.damping_factor * joints_.damping[k] : 0.0);
    }
  }

  // Returns the command of this period; `words` are an operator's.
  JointCommand tick(double now, const std::optional<Measurement>& measurement, const Names& words) {
    asked.reset();
    if (!fault.empty()) return damped(pose_);
    try {
      watch.message(now, measurement);
      for (const auto& word : words) obey(now, *measurement, word);
      // Braking ends what is wrong with these in any case.
      if (state == State::stand || state == State::policy) watch.motion(*measurement);
      JointCommand command = command_of(now, *measurement);
      check_finite(command, joints_);
      command = effort_limit(command, *measurement);
      // Once more, as readings of 1e300 may meet there.
      check_finite(command, joints_);
      pose_ = command.pos;
      return command;
    } catch (const std::exception& error) {
      fail(now, error.what());
    } catch (...) {
      fail(now, "an unknown error");
    }
    return damped(pose_);
  }

  // Damp the motors for good, and say why, once.
  void fail(double now, const std::string& why) {
    if (!fault.empty()) return;
    fault = why;
    enter(now, State::damp, "fault: " + why);
    ends_at = now + times_.damp_seconds;
  }

  // Whether the motors have been damped for long enough at the end.
  bool is_over(double now) const { return now >= ends_at; }

  bool is_standing(double now) const { return state == State::stand && now - since >= times_.stand_seconds; }

  // Whether the policy may begin: the robot stands, and the dry run in this pose is over.
  bool may_begin(double now) const { return is_standing(now) && dry.is_over(); }

  PolicyControl& control;
  DryRun& dry;
  Watch watch;
  EffortLimit effort_limit;
  Note note;
  std::optional<JointCommand> asked;  // what a policy that runs dry would have asked for in this period
  State state = State::dry;
  std::string fault;
  double since = 0.0;
  double ends_at = infinity;

 private:
  void obey(double now, const Measurement& measurement, const std::string& word) {
    const bool is_at_rest = state == State::damp || state == State::dry;
    if (word == "damp" || (word == "stop" && is_at_rest)) {
      enter(now, State::damp, "operator: " + word);
      ends_at = std::min(ends_at, now + times_.damp_seconds);
      return;
    }
    if (word == "stand" && state == State::dry) {
      note(now, "operator: 'stand' has to wait until the dry run is over");
      return;
    }
    const std::optional<State> to = led_to(word);
    // Behind a stop there is the end alone.
    if (!to || ends_at < infinity) {
      note(now, "operator: '" + word + "' leads nowhere from " + name_of(state));
      return;
    }
    if (to == State::policy && !may_begin(now)) {
      const char* wanted = is_standing(now) ? "the dry run is over" : "the robot stands";
      note(now, std::string("operator: 'policy' has to wait until ") + wanted);
      return;
    }
    first_share_ = share_;
    first_pose_ = share_ == 0.0 ? measurement.joint_pos : pose_;
    if (to == State::policy) control.begin();
    if (to == State::stand) dry.begin();
    enter(now, *to, "operator: " + word);
  }

  // What a word leads to from here. A fault leads to damp from everywhere, and nothing leads out of that.
  std::optional<State> led_to(const std::string& word) const {
    const bool is_up = state == State::stand || state == State::policy;
    if (word == "stand" && (state == State::damp || state == State::policy)) return State::stand;
    if (word == "policy" && state == State::stand) return State::policy;
    if (word == "stop" && is_up) return State::stop;
    return std::nullopt;
  }

  void enter(double now, State to, const std::string& why) {
    note(now, std::string(name_of(state)) + " -> " + name_of(to) + ": " + why);
    state = to;
    since = now;
  }

  JointCommand command_of(double now, const Measurement& measurement) {
    const double passed = now - since;
    switch (state) {
      case State::damp:
        return damped(measurement.joint_pos);
      case State::dry:
        run_dry(now, measurement, false);
        return damped(measurement.joint_pos);
      case State::stand: {
        if (is_standing(now)) run_dry(now, measurement, true);
        const double share = smooth(passed, times_.stand_seconds);
        return held(between(first_pose_, joints_.default_pos, share), between(first_share_, 1.0, share));
      }
      case State::stop:
        return stopping(now, passed);
      case State::policy:
        break;
    }
    JointCommand command = control(measurement);
    const double share = smooth(passed, times_.blend_seconds);
    share_ = 1.0;
    command.pos = between(first_pose_, command.pos, share);
    for (double& value : command.vel) value *= share;
    for (double& value : command.effort) value *= share;
    return command;
  }

  // Run one step of the policy without sending its action, and report after the last what it would have sent.
  void run_dry(double now, const Measurement& measurement, bool stands) {
    if (dry.is_over()) return;
    asked = dry(measurement);
    if (!dry.is_over()) return;
    for (const auto& line : dry.lines()) note(now, line);
    dry.check(stands);
    if (state == State::dry) enter(now, State::damp, "the dry run is over");
  }

  JointCommand stopping(double now, double passed) {
    const double share = smooth(passed, times_.stop_seconds);
    const JointCommand command = held(first_pose_, first_share_ * (1.0 - share));
    if (share == 1.0) {
      enter(now, State::damp, "stopped");
      ends_at = now + times_.damp_seconds;
    }
    return command;
  }

  // The command that holds a pose with a share of the stiffness, and brakes with the rest.
  JointCommand held(const Numbers& pose, double share) {
    share_ = share;
    const Numbers still(pose.size(), 0.0);
    Numbers stiffness = joints_.stiffness;
    for (double& value : stiffness) value *= share;
    return {pose, still, still, stiffness, between(braking_, joints_.damping, share)};
  }

  JointCommand damped(const Numbers& pose) { return held(pose, 0.0); }

  const Joints& joints_;
  Times times_;
  Numbers braking_;
  // What was asked for last: hand-overs begin there.
  Numbers pose_;
  double share_ = 0.0;
  // Where a hand-over began.
  Numbers first_pose_;
  double first_share_ = 0.0;
};

// Makes a fault of whatever others' code throws: motors would stay as they are.
template <typename Action>
void damping_after(const char* what, StateMachine& machine, double now, Action&& action) {
  try {
    action();
  } catch (const std::exception& error) {
    machine.fail(now, std::string(what) + ": " + error.what());
  } catch (...) {
    machine.fail(now, std::string(what) + ": an unknown error");
  }
}

}  // namespace ksim
