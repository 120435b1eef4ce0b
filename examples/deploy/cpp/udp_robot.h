// A robot that speaks lines of text in datagrams on the loopback address: what simulated_robot.py is, and what a driver
// of yours in another language may be. A robot with a bus of its own is a class like this one.
#pragma once

#include <cstring>

#include <arpa/inet.h>
#include <fcntl.h>
#include <sys/socket.h>

#include "deadlines.h"
#include "messages.h"

namespace ksim {

// A measurement is what `measurement_of` reads, a command `POS VEL EFFORT STIFFNESS DAMPING`, lists with commas. The first
// datagram to the robot, `hello`, tells it where the loop is.
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
      const std::string line(datagram, static_cast<size_t>(size));
      newest_ = measurement_of(fields_of(line), 0, Clock::now());
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

  int socket_;
  std::optional<Measurement> newest_;
};

}  // namespace ksim
