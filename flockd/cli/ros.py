"""`flockd ros`: the fleet in ROS 2, orders from there, and perception alone for other people's stacks."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack, suppress

from flockd.cli.options import add_endpoint_options, add_operator_option, endpoints
from flockd.cli.output import complain, say
from flockd.cli.parser import ALONE, Commands, Parser, commands_of, existing, flag, option
from flockd.core.errors import ExitCode

_NOTES = """\
Without a command it publishes each drone of the fleet in its namespace, as in `ros2 topic echo /drone1/odometry`.
A sourced ROS 2 is used where there is one; else: pip install -e '.[ros]'. docs/ros.md lists the topics."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd ros",
        "flockd ros --connect tcp/10.0.0.11:7447 --connect tcp/10.0.0.12:7447 --orders",
        "flockd ros perceive --config my_drone.yaml",
    )
    what = "Publish the fleet in ROS 2, and take orders from there. With `perceive`: only detect drones."
    parser = commands("ros", what, examples, notes=_NOTES)
    _add_perceive(commands_of(parser))
    add_endpoint_options(parser, "--drones-at")
    flag(parser, "--orders", "offer services and topics that order drones (default: watch only)")
    add_operator_option(parser)
    _add_network(parser)
    parser.set_defaults(run=_run)
    parser.usage = ALONE


def _add_network(parser: Parser) -> None:
    flag(parser, "--network", "let ROS 2 nodes on other computers find it (default: only those on this one)")


def _add_perceive(commands: Commands) -> None:
    examples = (
        "flockd ros perceive --config my_drone.yaml --vehicle /mavros/local_position/odom",
        "flockd ros perceive --config my_drone.yaml",
    )
    notes = (
        "It publishes NAME/neighbours (PoseArray), NAME/neighbours/tracks (PointCloud2) and NAME/diagnostics, with\n"
        "NAME and all cameras from the configuration. Without --vehicle it needs `perception.scale: network`."
    )
    parser = commands(
        "perceive", "Detect drones in the images of topics and publish them; command no vehicle.", examples, _perceive,
        notes=notes,
    )  # fmt: skip
    option(parser, "--config FILE", "the drone's configuration, with `source`", existing, required=True)
    option(parser, "--vehicle TOPIC", "odometry, pose or IMU of the vehicle in REP 103's axes, or PX4's own odometry")
    _add_network(parser)


def _perceive(args: argparse.Namespace) -> int:
    """Runs until Ctrl-C."""
    from flockd.core.config import load_drone
    from flockd.fleet.ros.perceive import PerceptionNode, check
    from flockd.fleet.ros.ros_node import RosNode
    from flockd.onboard.sources import open_source

    config = load_drone(args.config)
    check(config, args.vehicle)
    source = open_source(config, str(args.config))
    with ExitStack() as stack, suppress(KeyboardInterrupt):
        node = stack.enter_context(RosNode("flockd_perceive", here_only=not args.network))
        perception = PerceptionNode(config, node, args.vehicle)
        say(f"drones that {config.name} sees are published; Ctrl-C ends it")
        sys.stdout.flush()
        perception.run(source)
    return ExitCode.DONE


def _run(args: argparse.Namespace) -> int:
    """Runs until Ctrl-C."""
    from flockd.fleet.live_fleet import LiveFleet
    from flockd.fleet.ros.fleet_bridge import FleetBridge
    from flockd.fleet.ros.ros_node import RosNode
    from flockd.fleet.watcher import FleetWatcher

    listen, connect = endpoints(args)
    with ExitStack() as stack, suppress(KeyboardInterrupt):
        watcher = FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config)
        source = stack.enter_context(LiveFleet(stack.enter_context(watcher)))
        node = stack.enter_context(RosNode("flockd", here_only=not args.network))
        bridge = stack.enter_context(FleetBridge(source, node, may_command=args.orders, operator=args.operator))
        if not bridge.has_transforms:
            complain("this ROS 2 has no tf2_msgs, so there is no /tf; the markers for RViz are in `map` and need none")
        if args.orders and args.network:
            complain("whoever reaches this ROS domain may order what this computer may; use SROS 2, or drop --network")
        say(f"each drone found at {', '.join([*listen, *connect])} is published in its namespace; Ctrl-C ends it")
        sys.stdout.flush()
        bridge.wait()
    return ExitCode.DONE
