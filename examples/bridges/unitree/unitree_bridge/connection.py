"""The network: one participant on one interface, and its topics."""

from typing import Any

from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

COMMANDS = "rt/lowcmd"
STATES = "rt/lowstate"
_CONFIG = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="{interface}"{multicast}/></Interfaces>
    {no_multicast}
  </General>
  <Discovery><ParticipantIndex>auto</ParticipantIndex>{peers}</Discovery>
</Domain></CycloneDDS>
"""
_PEERS = '<Peers><Peer Address="127.0.0.1"/></Peers>'
# A domain is configured once in a process.
_domains: dict[int, Domain] = {}


def participant(interface: str, domain: int) -> DomainParticipant:
    """Return a participant of a DDS domain on a network interface; `lo` finds others of this computer."""
    if domain not in _domains:
        # The loopback has no multicast: others are asked for at its address.
        is_loopback = interface == "lo"
        config = _CONFIG.format(
            interface=interface,
            multicast=' multicast="false"' if is_loopback else "",
            no_multicast="<AllowMulticast>false</AllowMulticast>" if is_loopback else "",
            peers=_PEERS if is_loopback else "",
        )
        _domains[domain] = Domain(domain, config)
    return DomainParticipant(domain)


def writer(of: DomainParticipant, name: str, kind: Any) -> DataWriter:
    """Return what sends messages of a topic."""
    return DataWriter(of, Topic(of, name, kind))


def reader(of: DomainParticipant, name: str, kind: Any) -> DataReader:
    """Return what receives messages of a topic; it keeps the newest."""
    return DataReader(of, Topic(of, name, kind))


def take(of: DataReader, kind: Any) -> list[Any]:
    """Return the messages that have arrived since the last call; that a sender has left is no message."""
    return [message for message in of.take(N=16) if isinstance(message, kind)]
