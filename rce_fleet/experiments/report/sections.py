"""What the page says about each experiment, and its tables; with the page's parts that no data change."""

from __future__ import annotations

from dataclasses import dataclass

from rce_fleet.experiments.report.explanations import NETWORK
from rce_fleet.experiments.report.judging import MIN_RATIO, SAME_RATIO
from rce_fleet.experiments.report.measurements import Quantity
from rce_fleet.experiments.report.tables import TableSpec
from rce_fleet.experiments.statistics import CONFIDENCE, MIN_RUNS, RESAMPLES, repeat_shares

_CLIENT_NETWORK = Quantity("client.network_in", "+", "client.network_out")
_PACKETS = tuple(
    Quantity(f"{machine}.packets_in", "+", f"{machine}.packets_out") for machine in ("server", "client")
)


def _quantities(*names: str) -> tuple[Quantity, ...]:
    return tuple(Quantity(name) for name in names)


_DELIVERY = TableSpec(
    "Rate, delay and loss",
    _quantities("rate", "received", "lost", "delay_p50", "delay_p95", "delay_p99"),
)
_TRAFFIC = TableSpec("Network", (NETWORK, _CLIENT_NETWORK, *_PACKETS, *_quantities("message_bytes")))
_USE = TableSpec(
    "CPU and memory",
    _quantities("server.cpu", "client.cpu", "link.cpu", "server.memory", "client.memory"),
)


@dataclass(frozen=True)
class Section:
    """A part of the page about an experiment.

    Attributes:
        experiment: Its name in the raw data.
        title: The heading.
        text: What is measured.
        tables: Its tables.
    """

    experiment: str
    title: str
    text: str
    tables: tuple[TableSpec, ...]


SECTIONS = (
    Section(
        "laser",
        "Laser scans",
        "Machine 2 simulates TurtleBots that publish laser scans; machine 1 subscribes to all scans and "
        "prints them (`printed=yes`) or not. `client_cpu=full` has machine 2 as full with the "
        "simulation as the paper's: it has 0.2 of a core, and making a scan takes so much of it "
        "(`scan_work`) that the robots of SMS publish at about 7.5 Hz. With `rate=free`, robots "
        "publish as fast as they can, at most at 30 Hz; with `rate=fixed`, at 4 Hz, which all systems "
        "reach. Rates are per robot. A delay is the time from the scan's stamp until it is printed; all "
        "machines have the same clock.",
        (_DELIVERY, _TRAFFIC, _USE),
    ),
    Section(
        "round-trip",
        "Round trip",
        "A message is published at its `origin`, published again by the other machine, and received at its"
        " origin. In CRS, machine 1 publishes from a container (`origin=container`) or from the graph "
        "outside of it (`origin=server`). `delay` is what the link adds in each direction, in "
        "milliseconds; columns are sizes of the message in bytes.",
        (
            TableSpec("Round trip, median of a run (`round_trip`)", _quantities("round_trip"), "bytes"),
            TableSpec(
                "Round trip, 95th percentile of a run (`round_trip_p95`)",
                _quantities("round_trip_p95"),
                "bytes",
            ),
            TableSpec("Messages without an answer (`lost`)", _quantities("lost"), "bytes"),
        ),
    ),
    Section(
        "images",
        "Images",
        "Images go from machine 2 to machine 1, which prints them on a console (`printed=yes`) or not. "
        "`rate=carried` is a rate at which the link carries raw images of that size: 20 Hz for 160x120, 3 Hz "
        "for 640x480, 0.5 Hz for 1920x1080. It is measured from before the first message until the last one "
        "has arrived, and a next part begins when nothing of it is under way: all bytes and CPU time belong "
        "to its messages. `rate=above` asks for 30 Hz, more than the link carries; its `message_bytes` is of "
        "all of its messages, the other figures of 3 s in the middle. "
        "`encoding=png` is made by a converter of the engine, so only CRS has it.",
        (_DELIVERY, _TRAFFIC, _USE),
    ),
    Section(
        "scaling",
        "Number of robots",
        "Laser scans at 30 Hz as above, not printed, from more and more robots. In CRS, all robots share a "
        "container (`containers=one`) or have their own (`containers=each`); the other systems have none, "
        "and their rows say `containers=one`. `start` is the time until the topics of all robots arrive.",
        (
            _DELIVERY,
            TableSpec("Round trip and start", _quantities("round_trip", "start")),
            _TRAFFIC,
            _USE,
        ),
    ),
    Section(
        "robustness",
        "Faults",
        "Machine 2 takes a topic of machine 1 (10 messages a second), calls a service there, and looks for "
        "topics that are newly made there. `core_killed` kills a ROS core: that of machine 1 in SMS and MMS, "
        "that of machine 2 in CRS. `master_killed` kills what connects the machines: discovery and sync of "
        "machine 1 in MMS, the engine's master in CRS. What was killed is started again after 5 s; "
        "the engine starts its master again by itself, at once. `machine_cut` has the link of machine 2 lose "
        "everything for 20 s. Programs are not started again. `..._stopped` is the longest time without an "
        "answer, beyond the usual period. What did not come back (`..._came_back` is 0) has the time for "
        "which it was observed.",
        (
            TableSpec(
                "Time without an answer",
                _quantities("topics_stopped", "services_stopped", "new_topics_stopped"),
            ),
            TableSpec(
                "Came back (1) or not (0), and messages lost",
                _quantities(
                    "topics_came_back", "services_came_back", "new_topics_came_back", "lost_messages"
                ),
            ),
        ),
    ),
    Section(
        "isolation",
        "What a robot sees of others",
        "Counted from one robot: topics, nodes and parameters of another robot that it sees, the most of two "
        "looks 2 s apart, as what is shared may come late, and whether "
        "it can publish to it, call its service, end its nodes and call its core (1) or not (0). "
        "A run begins when the scans of both robots, which are shared, are heard on machine 1 (CRS: in the "
        "robots' containers). "
        "`files_to_add` and `lines_to_add` are what has to be written for one more robot.",
        (
            TableSpec(
                "Visible", _quantities("topics_visible", "topics_others", "nodes_others", "parameters_others")
            ),
            TableSpec("Possible", _quantities("can_publish", "can_call", "can_end_nodes", "can_use_core")),
            TableSpec("To add a robot", _quantities("files_to_add", "lines_to_add")),
        ),
    ),
    Section(
        "offload",
        "Tasks on the robot or in the cloud",
        "A robot's nodes on the robot, which has a netbook's share of a core (`place=robot`; nothing "
        "crosses the link, so one link is enough), or in the cloud (`place=cloud`), over the link's `rate` "
        "in Mbit/s and `delay` in milliseconds in each direction. `task=navigation` drives 1 m to a goal by "
        "AMCL and `move_base`, `task=planning` asks for a plan across the floor, and `task=mapping` makes a "
        "map of an arc of 2 s. All begin at the same place of the floor, over every link and in both places; "
        "links come in random order. `control_delay` is the time from a scan's stamp until a command or pose "
        "that was made of it, or of a newer scan, is at the robot. A task that is not done within 8 s (4 s "
        "for four plans) has failed: its time counts as that. Energy is computed by the robot's model. "
        "Of the tables about break-even, the first one takes the cloud as faster where a verdict would (the "
        "intervals do not overlap, and the medians differ by 5 %); the second one says where the medians "
        "cross, however little they differ.",
        (
            TableSpec("Task", _quantities("task_time", "control_delay", "energy", "success")),
            TableSpec("Use", _quantities("robot.cpu", "server.cpu", "robot.network_in", "robot.network_out")),
        ),
    ),
)
LINK_TABLE = TableSpec(
    "The link as measured (experiment `link`)",
    _quantities("round_trip", "round_trip_p99", "rate", "rate_back", "lost"),
)
MACHINE_TABLE = TableSpec("The computer's speed as measured (experiment `machine`)", _quantities("work"))

READING = f"""\
- *Median and interval.* `7.50 [7.41, 7.62]` is the median of the runs and its {100 * CONFIDENCE:.0f} %
  confidence interval, by the expanded percentile bootstrap with {RESAMPLES} samples: its percentiles are
  further out the fewer runs there are, since samples drawn from few runs vary too little (T. C. Hesterberg,
  "What Teachers Should Know About the Bootstrap", 2015). Fewer than {MIN_RUNS} runs have no interval:
  `7.50 (2 runs)`. `-` was not measured, or does not apply.
- *Which rows.* Each number comes from the rows of `results.csv` with the experiment of the section, the
  system, software and factors of the table's row, and the metric of the table's column. A column such as
  `server.network_in + server.network_out` is computed in each run. Warm-ups (run 0) do not count.
- *Names.* SMS is `single_master`, MMS is `multi_master`, CRS is `cloud` in the raw data. Machine 1 is
  `server`, machine 2 is `client`. Software `ros` is ROS 1 as Debian packages it, with programs in Python
  (rospy); `roscpp` is the same with programs in C++; `rce` is the core and the nodes of RCE. In CRS, the
  engine and the nodes in containers are RCE; the software is that of the robots. In MMS, discovery and sync
  are RCE with any software. A verdict is about the software of its row only.
- *Verdicts.* A claim *holds* if it holds in all cases (combinations of factors), *does not hold* if it
  holds in none, and otherwise *depends*. A system is *above* another one if their intervals do not overlap
  and the medians differ by at least {100 * (MIN_RATIO - 1):.0f} %. *About the same* are medians of which
  the largest is at most {SAME_RATIO:g} times the smallest. *Met* counts the comparisons that a claim is
  made of: "SMS above MMS 1 of 4" is met in one of four cases.
- *Effect size.* Cliff's delta of two systems: how much likelier a run of the first one is above a run of
  the second one than below, from -1 to +1. Up to 0.147 it is negligible, up to 0.33 small, up to 0.474
  medium, above that large.
- *CPU* is in cores: 1.0 is one core. `link.cpu` is that of the emulated link, and is in no machine's CPU.
"""


def limits() -> str:
    """Return what the measurements cannot tell, as Markdown. It simulates for a second."""
    return f"""\
- Machines are network namespaces of one computer and share its cores: where they need more than there is,
  they slow each other down. Ratios carry over to other computers, absolute numbers do not.
- The link is emulated: rate, delay and jitter are those of a wireless LAN. It loses no frame, as such a LAN
  sends again what was lost; radio channels, roaming and other senders are missing.
- The robots are simulated, and the scans and images are made by programs.
- The paper does not tell all of its set-up. A claim that does not hold here may have held there; the
  verdict is about the versions above.
- All runs of an experiment were made on one computer, at the hours told above (`started`, `resumed`): the
  intervals say how well it repeats itself in these, not how other computers and hours differ. Where
  nothing but chance differs, some {100 * repeat_shares(10, 10).estimate:.0f} % of the medians of another ten
  runs lie in the intervals; what another full run found is told above.
- An interval of ten runs has the true median in some 96 of 100 experiments. That of three runs reaches from
  the least to the greatest value: such a range has the true median in 75 of 100 experiments, and the median
  of another three runs in 60. Among so many comparisons, some differ by chance; so a verdict needs a
  difference of {100 * (MIN_RATIO - 1):.0f} % and looks at all cases.
- Several runs of `robustness` and `isolation` are done at the same time: most of such a run is waiting, and
  neither CPU nor delays are measured in it.
- The original programs of fkie and the original Rapyuta are judged only where a row names them.
"""
