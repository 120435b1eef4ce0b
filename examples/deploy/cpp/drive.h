// Runs an exported policy on a robot of yours: what the main function of your program calls.
#pragma once

#include <ctime>

#include "run_loop.h"

namespace ksim {

// A robot that is read, and sent nothing: it may stand under another controller meanwhile.
class HeardRobot : public Robot {
 public:
  explicit HeardRobot(Robot& robot) : robot_(robot) {}
  std::optional<Measurement> read() override { return robot_.read(); }
  void write(const JointCommand&) override {}

 private:
  Robot& robot_;
};

inline std::string log_path(const Options& options) {
  if (!options.log.empty()) return options.log;
  const std::time_t now = std::time(nullptr);
  char name[64];
  std::strftime(name, sizeof name, "loop_%Y%m%d_%H%M%S.csv", std::localtime(&now));
  return name;
}

inline void tell(const Punctuality& found, const StateMachine& machine, double period, const Options& options) {
  const double median = found.own.quantile(0.5);
  const double jitter = 1e3 * (found.own.quantile(0.99) - median);
  const double memory = resident_mib();
  std::cout << text("%ld periods of %g ms, %ld missed; 99 %% with own jitter up to %.2f ms, and sent up to %.2f ms after "
                    "the deadline\n",
                    found.periods, 1e3 * period, found.missed, jitter, 1e3 * found.late.quantile(0.99));
  for (size_t k = 0; k < machine.effort_limit.counts.size(); ++k) {
    const long count = machine.effort_limit.counts[k];
    if (count > 0) std::cout << "commands of " << machine.control.joints.names[k] << " at the effort limit: " << count << "\n";
  }
  if (options.report.empty()) return;
  std::ofstream report(options.report);
  report << text("{\"periods\": %ld, \"missed_periods\": %ld, \"own_ms_median\": %.5f, \"own_jitter_ms_p99\": %.5f, "
                 "\"woken_late_ms_p99\": %.5f, \"memory_mib_early\": %.3f, \"memory_mib_last\": %.3f, \"fault\": %s}\n",
                 found.periods, found.missed, 1e3 * median, jitter, 1e3 * found.woken.quantile(0.99),
                 // JSON has no NaN: of a run that was too short.
                 std::isnan(found.memory_early) ? memory : found.memory_early, memory,
                 machine.fault.empty() ? "false" : "true");
}

// Returns the exit code: 1 after a fault. A std::runtime_error says what is wrong before anything moves.
inline int drive(Robot& robot, PolicyControl& control, const Options& options) {
  const double period = control.step_dt;
  DryRun dry(control, period, options.times.dry_seconds, options.limits.position_margin, Clock::now);
  HeardRobot heard(robot);
  Robot& driven = options.dry_run ? heard : robot;
  const Measurement first = first_measurement(driven, period);
  const Names lacking = control.lacking(first);
  if (!lacking.empty()) {
    throw std::runtime_error("the policy observes " + joined(lacking) +
                             ", which this robot does not measure: give estimates, or train without these observations");
  }
  Journal journal(log_path(options), control.joints);
  const auto note = [&journal](double now, const std::string& line) { journal.event(now, line); };
  StateMachine machine(control, dry, period, options.limits, options.times, note);
  Interrupts interrupts;
  Keyboard keyboard(options.seconds == 0.0 && !options.dry_run);
  Unattended unattended(options.seconds);
  std::vector<Operator> operators;
  operators.push_back([&interrupts](double, const StateMachine&) { return interrupts.words(); });
  operators.push_back([&keyboard](double, const StateMachine&) { return keyboard.words(); });
  if (options.dry_run) {
    operators.push_back([](double, const StateMachine& at) {
      const bool is_done = at.state == State::damp && at.ends_at == infinity;
      return is_done ? Names{"stop"} : Names{};
    });
  } else if (options.seconds > 0.0) {
    operators.push_back([&unattended](double now, const StateMachine& at) { return unattended.words(now, at); });
  }
  const double began = Clock::now();
  journal.event(began, options.real_time ? ask_for_real_time() : "no real-time priority: not asked for");
  for (const auto& line : unguarded(control.joints, first)) journal.event(began, line);
  for (const auto& command : control.commands) {
    journal.event(began, "command " + command.name + ": " + as_words(command.values) + ", of " + command.range());
  }
  const Punctuality found = run_loop(driven, machine, operators, journal, period);
  journal.close();
  tell(found, machine, period, options);
  if (journal.is_torn) std::cout << "the log is not whole: is the disk full?\n";
  if (journal.lost > 0) std::cout << journal.lost << " lines of the log were lost\n";
  const bool is_half = options.dry_run && !dry.is_over();
  return machine.fault.empty() && !is_half ? 0 : 1;
}

}  // namespace ksim
