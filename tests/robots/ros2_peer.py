"""ROS 2 nodes for the tests and benchmarks, in a process of their own."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import time

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

DT = 0.002


def node_in(domain):
    rclpy.init(domain_id=int(domain))
    return rclpy.create_node("peer")


def stamped(kind, t):
    message = kind()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(t * 1e9), 10**9)
    return message


def wrench_message(t, values):
    message = stamped(WrenchStamped, t)
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = map(float, values)
    return message


def pose_message(t, values):
    message = stamped(PoseStamped, t)
    q, p = message.pose.orientation, message.pose.position
    q.w, q.x, q.y, q.z, p.x, p.y, p.z = map(float, values)
    return message


def wait_for(publisher):
    while publisher.get_subscription_count() == 0:
        time.sleep(0.01)
    time.sleep(1.0)  # until the other side has connected


def faults(domain):
    """Publish wrenches of a tool at rest: invalid messages, silence, clock, restart."""
    node = node_in(domain)
    publisher = node.create_publisher(WrenchStamped, "/ft/wrench", qos_profile_sensor_data)
    print("ready", flush=True)
    wait_for(publisher)
    start, numbers = time.time(), iter(range(10**6))

    def send(number, *, shift=0.0, flaw=""):
        values = np.array([number % 500, 2.0, 3.0, 0.1, 0.2, 0.3])
        if flaw == "nan":
            values[1] = math.nan
        if flaw == "huge":
            values[1] = 1e7
        if flaw == "saturated":
            values[1] = 600.0
        message = wrench_message(start + DT * number + shift, values)
        if flaw == "short":
            publisher.publish(serialize_message(message)[:-9])
            return
        publisher.publish(message)

    def play(count, **options):
        for _ in range(count):
            number = next(numbers)
            time.sleep(max(0.0, start + DT * number - time.time()))
            send(number, **options)

    play(60)
    for flaw in ("nan", "short", "huge", "saturated"):
        play(1, flaw=flaw)
        play(20)
    play(1, shift=-6 * DT)  # older than the previous one
    play(60)
    for _ in range(100):  # silence
        next(numbers)
    play(60)
    play(400, shift=50.0)  # a clock is set
    # Another node of the same topic: its numbers restart.
    node.destroy_publisher(publisher)
    publisher = node.create_publisher(WrenchStamped, "/ft/wrench", qos_profile_sensor_data)
    wait_for(publisher)
    start = time.time() - DT * next(numbers)
    while True:
        play(100, shift=50.0)


def echo(domain, topic):
    """Print each wrench, and each diagnosis, of a topic as a line of JSON."""
    node = node_in(domain)

    def wrench(message):
        f, tau = message.wrench.force, message.wrench.torque
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        values = [f.x, f.y, f.z, tau.x, tau.y, tau.z]
        found = {"wrench": values, "frame": message.header.frame_id, "t": stamp}
        print(json.dumps(found | {"late": time.time() - stamp}), flush=True)

    def diagnosis(message):
        (status,) = message.status
        pairs = {pair.key: pair.value for pair in status.values}
        found = {"name": status.name, "message": status.message, "level": ord(status.level)}
        print(json.dumps(found | {"values": pairs}), flush=True)

    best_effort = QoSProfile(depth=512, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(WrenchStamped, topic, wrench, best_effort)
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnosis, 100)
    while not node.get_publishers_info_by_topic(topic):
        time.sleep(0.01)
    (info,) = node.get_publishers_info_by_topic(topic)
    print(json.dumps({"hash": str(info.topic_type_hash), "type": info.topic_type}), flush=True)
    rclpy.spin(node)


def moving(domain, table, hz):
    """Publish wrench and pose of a tool from a table of 13 columns, which may be replaced."""
    node = node_in(domain)
    rows, dt, changed = np.load(table), 1.0 / float(hz), os.stat(table).st_mtime_ns
    wrenches = node.create_publisher(WrenchStamped, "/ft/wrench", qos_profile_sensor_data)
    poses = node.create_publisher(PoseStamped, "/ft/pose", qos_profile_sensor_data)
    print("ready", flush=True)
    start, first = time.time(), 0
    for k in range(10**9):
        if k % 100 == 0 and os.stat(table).st_mtime_ns != changed:
            rows, changed, first = np.load(table), os.stat(table).st_mtime_ns, k
        row, t = rows[(k - first) % len(rows)], start + dt * k
        time.sleep(max(0.0, t - time.time()))
        poses.publish(pose_message(t, row[6:]))
        wrenches.publish(wrench_message(t, row[:6]))


def run_calls(domain):
    """Call services and set parameters of /drake_teleop as requested by lines on stdin."""
    node = node_in(domain)
    parameters = AsyncParameterClient(node, "/drake_teleop")
    clients = {
        name: node.create_client(Trigger, f"/drake_teleop/{name}")
        for name in ("tare", "load", "calibrate")
    }
    parameters.wait_for_services(timeout_sec=60.0)
    for client in clients.values():
        client.wait_for_service(timeout_sec=60.0)
    time.sleep(1.0)  # until the node has found the clients; earlier requests can be lost
    for line in sys.stdin:
        name, *words = line.split()
        if name == "set":
            value = words[1] if words[0] in ("load", "until") else float(words[1])
            value = " ".join(words[1:]) if words[0] == "until" else value
            future = parameters.set_parameters([Parameter(words[0], value=value)])
        else:
            future = clients[name].call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=200.0)
        result = future.result()
        if name == "set":
            answer = [result.results[0].successful, result.results[0].reason]
        else:
            answer = [result.success, result.message]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        PEERS = {"faults": faults, "echo": echo, "moving": moving, "calls": run_calls}
        PEERS[sys.argv[1]](*sys.argv[2:])
