"""Simulated robot or sensor in its own process, with all kinds of faults.

`python peer.py netft` prints its port, serves one client, and ends after its sequence. It imports
only the libraries of its protocol. Each wrench is (number, 2, 3, 0.1, 0.2, 0.3), which identifies
the sample; the pose is that of a tool at rest.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import time

DT = 0.002
FLAWS = ("good", "lost", "twice", "swapped", "nan", "short", "saturated", "silent", "late", "good")
SEEN = ("good", "lost", "nans", "silent", "old", "good")  # clients that rarely read
TWO = ("good", "good")
LONG = 20
EACH = 6  # samples of a chapter; the fault is in its middle
SILENCE_S = 0.09
SATURATED = 1  # of the flags in a UDP packet


def chapters(flaws=FLAWS):
    """Yield (wait [s], number, flaw) in the order of sending."""
    number = 0
    for flaw in flaws:
        rows = [(DT, number + k, "") for k in range(EACH)]
        number += EACH
        middle = EACH // 2
        if flaw == "lost":
            del rows[middle : middle + 3]
        elif flaw == "twice":
            rows.insert(middle, (0.0, *rows[middle - 1][1:]))
        elif flaw == "swapped":
            rows[middle], rows[middle - 1] = rows[middle - 1], rows[middle]
        elif flaw == "silent":  # the clock continues
            rows[middle] = (SILENCE_S, *rows[middle][1:])
            gone = round(SILENCE_S / DT)
            rows = rows[:middle] + [(wait, n + gone, f) for wait, n, f in rows[middle:]]
            number += gone
        elif flaw == "late":  # earlier samples arrive now
            rows[middle] = (0.0, number - EACH - 60, "")
        elif flaw == "old":
            rows = [(DT, number - 40 + k, "") for k in range(LONG)]
            number += LONG - EACH
        elif flaw == "nans":
            rows = [(DT, number - EACH + k, "nan") for k in range(LONG)]
            number += LONG - EACH
        elif flaw != "good":
            rows[middle] = (*rows[middle][:2], flaw)
        yield from rows


def send_in_real_time(send, flaws=FLAWS):
    """Call send(number, flaw) in real time."""
    due = time.monotonic()
    for wait, number, flaw in chapters(flaws):
        due += wait
        time.sleep(max(0.0, due - time.monotonic()))
        send(number, flaw)


def wrench(number):
    return (float(number), 2.0, 3.0, 0.1, 0.2, 0.3)


def netft():
    """RDT box that is switched off and on: its numbers restart, and it needs a new request."""
    box = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    box.bind(("127.0.0.1", 0))
    box.settimeout(5.0)
    print(box.getsockname()[1], flush=True)

    def wait_for_request():
        while True:
            packet, there = box.recvfrom(16)
            if struct.unpack(">HHI", packet) == (0x1234, 2, 0):
                return there

    for flaws in (FLAWS, ("good",) * 3):
        there = wait_for_request()

        def send(number, flaw, there=there):
            counts = [round(1000 * x) for x in wrench(number)]
            status = {"saturated": 0x80020000, "nan": 0x80010000}.get(flaw, 0)
            record = struct.pack(">III6i", number, 7 * number, status, *counts)
            box.sendto(record[: 20 if flaw == "short" else 36], there)

        send_in_real_time(send, flaws)
        box.setblocking(False)
        with contextlib.suppress(BlockingIOError):  # requests during the silence
            while True:
                box.recv(16)
        box.settimeout(5.0)


def rtde(host, table=""):
    """Controller that restarts with time zero.

    With a table (wrench and pose, 12 doubles a row) it is a moving tool.
    """
    stories = (SEEN, 100.0), (("good",) * 20, 1.0)
    rows = []
    if table:
        with open(table, "rb") as file:
            rows = list(struct.iter_unpack("<12d", file.read()))
        stories = ((("good",) * (len(rows) // EACH), 100.0),)
    types = {
        "timestamp": "DOUBLE",
        "ft_raw_wrench": "VECTOR6D",
        "actual_TCP_pose": "VECTOR6D",
        "actual_tool_accelerometer": "VECTOR3D",
    }
    print(host, flush=True)
    for flaws, start in stories:
        with socket.create_server((host, 30004)) as door:
            robot, _ = door.accept()
        robot.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def send_message(kind, content, robot=robot):
            robot.sendall(struct.pack(">HB", 3 + len(content), ord(kind)) + content)

        names = []
        wait_for_request = robot.makefile("rb")
        while (head := wait_for_request.read(3))[2:] != b"S":
            kind, content = chr(head[2]), wait_for_request.read(int.from_bytes(head[:2], "big") - 3)
            if kind == "V":
                send_message(kind, b"\x01")
            elif kind == "v":
                send_message(kind, struct.pack(">4I", 5, 12, 0, 0))
            elif kind == "O":
                names = [name for name in content[8:].decode().split(",") if name]
                send_message(kind, b"\x01" + ",".join(types[name] for name in names).encode())
        send_message("S", b"\x01")

        def send(number, flaw, start=start, send_message=send_message, names=names):
            values = {
                "timestamp": (start + DT * number,),
                "ft_raw_wrench": wrench(number) if flaw != "nan" else (float("nan"),) * 6,
                "actual_TCP_pose": (0.4, 0.1, 0.3, 0.0, 0.0, 1.0),
                "actual_tool_accelerometer": (0.0, 0.0, 9.81),
            }
            if rows:
                values["ft_raw_wrench"] = rows[number][:6]
                values["actual_TCP_pose"] = rows[number][6:]
            numbers = [x for name in names for x in values[name]]
            send_message("U", b"\x01" + struct.pack(f">{len(numbers)}d", *numbers))

        send_in_real_time(send, flaws)
        robot.close()
        wait_for_request.close()
        time.sleep(0.06)


def router(port):
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def ros(port):
    """ROS 2 driver behind a router; it restarts, and then its clock is set.

    CDR, attachment and key are written explicitly.
    """
    kind = "geometry_msgs::msg::dds_::WrenchStamped_"
    with router(port) as session:
        publisher = session.declare_publisher(f"3/ft/wrench/{kind}/RIHS01_{HASH}")
        print(port, flush=True)
        while not publisher.matching_status.matching:
            time.sleep(0.002)
        for flaws, later, first in ((FLAWS, 0, 0), (TWO, 0, 0), (TWO, 50, 500)):
            start = time.time() + later

            def send(number, flaw, start=start, first=first):
                ns = round((start + DT * number) * 1e9)
                numbers = wrench(number) if flaw != "nan" else (float("nan"),) * 6
                stamp = struct.pack("<iII6s6x", ns // 10**9, ns % 10**9, 6, b"tool0")
                message = b"\0\1\0\0" + stamp + struct.pack("<6d", *numbers)
                attached = struct.pack("<qqB16s", number + first, ns, 16, b"x" * 16)
                publisher.put(message[: 20 if flaw == "short" else 76], attachment=attached)

            send_in_real_time(send, flaws)


def udp(port):
    """Sender that restarts, and then its clock is set; layout of the C header."""
    print(port, flush=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for flaws, later, first in ((FLAWS, 0, 0), (TWO, 0, 0), (TWO, 50, 500)):
            start = time.time() + later

            def send(number, flaw, start=start, first=first):
                numbers = wrench(number) if flaw != "nan" else (float("nan"),) * 6
                flags, t = SATURATED * (flaw == "saturated"), start + DT * number
                values = (*numbers, 0.0, 0.0, 9.81, *(0.0,) * 6)
                packet = struct.pack("<4sIQd15d", b"DTW1", flags, number + first, t, *values)
                sender.sendto(packet[: 20 if flaw == "short" else 144], ("127.0.0.1", int(port)))

            send_in_real_time(send, flaws)


def joint_state(ns, names, positions):
    """Return a sensor_msgs/JointState in CDR, without velocity and effort."""
    data = struct.pack("<iII5s", ns // 10**9, ns % 10**9, 5, b"base\0")

    def aligned(data, size):
        return data + b"\0" * (-len(data) % size)

    data = aligned(data, 4) + struct.pack("<I", len(names))
    for name in names:
        text = name.encode() + b"\0"
        data = aligned(data, 4) + struct.pack("<I", len(text)) + text
    data = aligned(data, 4) + struct.pack("<I", len(positions))
    data = aligned(data, 8) + struct.pack(f"<{len(positions)}d", *positions)
    return b"\0\1\0\0" + data + struct.pack("<II", 0, 0)


def moving(table, columns, epoch, send):
    """Call send(number, row) at the times of a table that began at `epoch`."""
    with open(table, "rb") as file:
        rows = list(struct.iter_unpack(f"<{columns}d", file.read()))
    while (k := int((time.time() - float(epoch)) / DT)) < len(rows):
        send(k, rows[k])
        time.sleep(max(0.0, float(epoch) + (k + 1) * DT - time.time()))


def netft_moving(table, columns, epoch):
    """RDT box on a moving tool."""
    box = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    box.bind(("127.0.0.1", 0))
    print(box.getsockname()[1], flush=True)
    _, there = box.recvfrom(16)

    def send(number, row):
        counts = [round(1e5 * x) for x in row[:6]]
        box.sendto(struct.pack(">III6i", number, 7 * number, 0, *counts), there)

    moving(table, columns, epoch, send)


def ros_moving(port, table, columns, epoch, names):
    """Wrench and joints of a moving tool, and joints of a gripper."""
    wrench_kind, joint_kind = (
        f"{package}::msg::dds_::{name}_"
        for package, name in (("geometry_msgs", "WrenchStamped"), ("sensor_msgs", "JointState"))
    )
    with router(port) as session:
        wrenches = session.declare_publisher(f"0/ft/wrench/{wrench_kind}/RIHS01_{HASH}")
        joints = session.declare_publisher(f"0/joint_states/{joint_kind}/RIHS01_0")
        print(port, flush=True)

        def send(number, row):
            ns = round((float(epoch) + DT * number) * 1e9)
            attached = struct.pack("<qqB16s", number, ns, 16, b"x" * 16)
            message = b"\0\1\0\0" + struct.pack("<iII6s6x", ns // 10**9, ns % 10**9, 6, b"tool0")
            wrenches.put(message + struct.pack("<6d", *row[:6]), attachment=attached)
            of_arm = joint_state(ns, names.split(",")[::-1], row[:5:-1])
            joints.put(of_arm, attachment=attached)
            joints.put(joint_state(ns, ["finger"], [0.1]), attachment=attached)

        moving(table, columns, epoch, send)


def ros_echo(port):
    """Print the first message as a ROS node receives it: tokens, key, attachment, CDR."""
    with router(port) as session:
        tokens = session.liveliness().declare_subscriber("@ros2_lv/**", history=True)
        messages = session.declare_subscriber("4/**")
        print(port, flush=True)
        for _ in range(2):
            print(tokens.recv().key_expr)
        message = messages.recv()
        print(message.key_expr)
        print(message.attachment.to_bytes().hex())
        print(message.payload.to_bytes().hex(), flush=True)


HASH = "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"


if __name__ == "__main__":
    with contextlib.suppress(OSError, KeyboardInterrupt):
        PEERS = {"udp": udp, "netft": netft, "rtde": rtde, "ros": ros, "ros_echo": ros_echo}
        PEERS |= {"netft_moving": netft_moving, "ros_moving": ros_moving}
        PEERS[sys.argv[1]](*sys.argv[2:])
