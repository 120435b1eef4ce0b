// The loop: at each deadline read the robot, ask the state machine, write the command, and log it.
#pragma once

#include <cstring>

#include <sched.h>
#include <sys/mman.h>

#include "journal.h"
#include "options.h"
#include "words.h"

namespace ksim {

// A source of operator words, which say what comes next: the words since the last period.
using Operator = std::function<Names(double, const StateMachine&)>;

// Waits for a robot's first message.
inline Measurement first_measurement(Robot& robot, double period) {
  constexpr double wait = 5.0;
  const double until = Clock::now() + wait;
  while (Clock::now() < until) {
    const auto found = robot.read();
    if (found) return *found;
    Clock::sleep_until(Clock::now() + period);
  }
  throw std::runtime_error(text("no message from the robot in %g s: is it on, and is it this network?", wait));
}

// Asks the system to run this thread before others, and to keep its memory; returns a line that says whether it does.
inline std::string ask_for_real_time() {
  constexpr int priority = 20;
  sched_param wanted{};
  wanted.sched_priority = priority;
  if (sched_setscheduler(0, SCHED_FIFO, &wanted) != 0) return std::string("no real-time priority: ") + strerror(errno);
  // Only a page that the system had taken away would be missed, so nothing depends on this.
  const bool is_kept = mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
  return text("real-time priority %d%s", priority, is_kept ? ", memory locked" : "");
}

// Runs a robot until the motors are damped at the end.
inline Punctuality run_loop(Robot& robot, StateMachine& machine, const std::vector<Operator>& operators,
                            Journal& journal, double period) {
  Punctuality punctuality;
  const double longest = machine.watch.longest;
  double deadline = Clock::now();
  while (true) {
    Clock::sleep_until(deadline);
    const double woken = Clock::now();
    if (woken - deadline > longest) {
      machine.fail(woken, text("the loop ran %.3f s late: is the computer busy?", woken - deadline));
    }
    std::optional<Measurement> measurement;
    Names words;
    damping_after("read", machine, woken, [&] { measurement = robot.read(); });
    damping_after("operator", machine, woken, [&] {
      Names said;
      for (const auto& one : operators) {
        for (const auto& word : one(woken, machine)) said.push_back(word);
      }
      words = sort_words(said, machine, woken);
    });
    const JointCommand command = machine.tick(woken, measurement, words);
    const double sent = Clock::now();
    damping_after("write", machine, sent, [&] { robot.write(command); });
    damping_after("log", machine, sent, [&] { journal.period(woken, machine.state, measurement, command, machine.asked); });
    punctuality.add(deadline, woken, sent);
    if (machine.is_over(sent)) return punctuality;
    const double done = Clock::now();
    if (done - woken > longest) {
      machine.fail(done, text("a period took %.3f s: is the computer busy?", done - woken));
    }
    deadline = next_deadline(deadline, period, done, punctuality.missed);
  }
}

}  // namespace ksim
