// A robot that speaks lines of text in datagrams on the loopback address: what simulated_robot.py is, and what a driver
// of yours in another language may be. A robot with a bus of its own is a class like this one.
#pragma once

#include <cstring>
#include <sstream>

#include <arpa/inet.h>
#include <fcntl.h>
#include <sys/socket.h>

#include "deadlines.h"
#include "robot_link.h"

namespace ksim {

// A measurement is `COUNT POS VEL EFFORT QUAT ANG_VEL [NAME=NUMBERS]...`, lists with commas, and - for what it has not; a
// command is `POS VEL EFFORT STIFFNESS DAMPING`. The first datagram to the robot, `hello`, tells it where the loop is.
class UdpRobot : public Robot {
 public:
  explicit UdpRobot(int port) : socket_(socket(AF_INET, SOCK_DGRAM, 0)) {
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    address.sin_port = htons(static_cast<uint16_t>(port));
    const bool is_open = socket_ >= 0 && connect(socket_, reinterpret_cast<sockaddr*>(&address), sizeof address) == 0;
    if (!is_open || fcntl(socket_, F_SETFL, O_NONBLOCK) != 0) throw std::runtime_error(strerror(errno));
  }

  ~UdpRobot() override { ::close(socket_); }

  UdpRobot(const UdpRobot&) = delete;
  UdpRobot& operator=(const UdpRobot&) = delete;

  std::optional<Measurement> read() override {
    if (!newest_) send("hello");
    char datagram[65536];
    // The newest of those that have arrived.
    while (true) {
      const ssize_t size = recv(socket_, datagram, sizeof datagram, 0);
      if (size < 0) break;
      newest_ = parsed(std::string(datagram, static_cast<size_t>(size)));
    }
    return newest_;
  }

  void write(const JointCommand& command) override {
    std::string line;
    for (const Numbers* values : {&command.pos, &command.vel, &command.effort, &command.stiffness, &command.damping}) {
      line += line.empty() ? listed(*values) : " " + listed(*values);
    }
    send(line);
  }

 private:
  void send(const std::string& line) {
    // A robot that is off refuses it: then no message comes, and the watch says so.
    const ssize_t sent = ::send(socket_, line.data(), line.size(), 0);
    static_cast<void>(sent);
  }

  static std::string listed(const Numbers& values) {
    std::string line;
    for (double value : values) line += text(line.empty() ? "%.9g" : ",%.9g", value);
    return line;
  }

  static Numbers numbers_in(const std::string& list) {
    Numbers found;
    std::istringstream parts(list);
    for (std::string part; std::getline(parts, part, ',');) found.push_back(std::strtod(part.c_str(), nullptr));
    return found;
  }

  static Measurement parsed(const std::string& line) {
    Names fields;
    std::istringstream parts(line);
    for (std::string part; parts >> part;) fields.push_back(part);
    if (fields.size() < 6) throw std::runtime_error(text("a message of %zu fields", fields.size()));
    Measurement found;
    found.stamp = Clock::now();
    if (fields[0] != "-") found.count = std::strtoll(fields[0].c_str(), nullptr, 10);
    found.joint_pos = numbers_in(fields[1]);
    found.joint_vel = numbers_in(fields[2]);
    found.joint_effort = numbers_in(fields[3]);
    if (fields[4] != "-") found.root_quat = numbers_in(fields[4]);
    if (fields[5] != "-") found.root_ang_vel = numbers_in(fields[5]);
    for (size_t k = 6; k < fields.size(); ++k) {
      const size_t mark = fields[k].find('=');
      found.estimates[fields[k].substr(0, mark)] = numbers_in(fields[k].substr(mark + 1));
    }
    return found;
  }

  int socket_;
  std::optional<Measurement> newest_;
};

}  // namespace ksim
