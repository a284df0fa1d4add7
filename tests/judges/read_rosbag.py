"""Decode a ROS 1 bag with the original rosbag (Debian's python3-rosbag): one JSON line a message.

Run by the system's Python, not by the project's. ``bytes`` become their length and SHA-256. Every message is decoded by
the class of Debian's message packages, after its definition's MD5 was found equal to the bag's.
"""

import hashlib
import json
import sys

import genpy
import rosbag
import roslib.message


def plain(value):
    if isinstance(value, bytes):
        return {"length": len(value), "sha256": hashlib.sha256(value).hexdigest()}
    if isinstance(value, genpy.Time):
        return {"sec": value.secs, "nanosec": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


with rosbag.Bag(sys.argv[1]) as bag:
    for topic, (kind, data, md5sum, _, _), t in bag.read_messages(raw=True):
        message_class = roslib.message.get_message_class(kind)
        if message_class is None or message_class._md5sum != md5sum:
            sys.exit(f"{topic}: {kind} has MD5 {md5sum}; the installed message class differs")
        message = message_class().deserialize(data)
        line = {"topic": topic, "type": kind, "t_ns": str(t.to_nsec()), "content": plain(message)}
        sys.stdout.write(json.dumps(line) + "\n")
