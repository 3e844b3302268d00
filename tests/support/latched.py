"""rospy nodes that latch what robots latch, and nodes that come late and tell what they heard."""

from __future__ import annotations

from pathlib import Path

MAP, TF, STRING = "nav_msgs/OccupancyGrid", "tf2_msgs/TFMessage", "std_msgs/String"
MAP_CELLS = 4_000_000

LATCHER = f"""#!/usr/bin/python3
import sys
import zlib
import rospy
from std_msgs.msg import String

name, kind, topic, text = sys.argv[1:5]
rospy.init_node(name)
if kind == "map":
    from nav_msgs.msg import OccupancyGrid
    message = OccupancyGrid()
    message.header.frame_id = text
    message.info.width = message.info.height = {int(MAP_CELLS**0.5)}
    message.info.resolution = 0.05
    row = [zlib.crc32((text + str(i)).encode()) % 102 - 1 for i in range(message.info.width)]
    message.data = row * message.info.height
    publisher = rospy.Publisher(topic, OccupancyGrid, queue_size=1, latch=True)
    publisher.publish(message)
elif kind == "tf":
    import tf2_ros
    from geometry_msgs.msg import TransformStamped
    broadcaster = tf2_ros.StaticTransformBroadcaster()
    found = []
    for number in range(2):
        one = TransformStamped()
        one.header.stamp = rospy.Time.now()
        one.header.frame_id = "base_link"
        one.child_frame_id = text + str(number)
        one.transform.rotation.w = 1.0
        found.append(one)
    broadcaster.sendTransform(found)
else:
    publisher = rospy.Publisher(topic, String, queue_size=1, latch=True)
    publisher.publish(text)
rospy.spin()
"""
"""``NAME KIND TOPIC TEXT``: latches one message. Transforms come from tf2's own broadcaster."""

LISTENER = """#!/usr/bin/python3
import sys
import zlib
import rospy
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

def say(heard):
    return ";".join(["heard", *(t + "=" + ",".join(sorted(found)) for t, found in sorted(heard.items()))])

kinds = {"map": OccupancyGrid, "tf": TFMessage, "string": String}
texts = {
    "map": lambda m: [f"{m.header.frame_id}:{m.info.width}x{m.info.height}:{len(m.data)}"],
    "tf": lambda m: [one.child_frame_id for one in m.transforms],
    "string": lambda m: [m.data],
}
wanted, subjects = sys.argv[1], sys.argv[2:]
rospy.init_node("late", anonymous=True)
answers = rospy.Publisher("/heard", String, queue_size=1, latch=True)
heard, times = {}, {}

def take(kind, topic):
    def on_message(message):
        for text in texts[kind](message):
            heard.setdefault(topic, set()).add(text)
            times[text] = times.get(text, 0) + 1
            print("took", topic, text, "of", message._connection_header["callerid"], flush=True)
    return on_message

keep = [rospy.Subscriber(t, kinds[k], take(k, t)) for k, t in (s.split(":", 1) for s in subjects)]
while say(heard) != wanted and not rospy.is_shutdown():
    rospy.sleep(0.05)
rospy.sleep(0.5)  # what else is latched has come with it
again = sorted(text for text, count in times.items() if count > 1)
text = say(heard) + (";twice=" + ",".join(again) if again else ".")
print(text, flush=True)
answers.publish(text)
rospy.spin()
"""
"""``WANTED KIND:TOPIC ...``: waits until it has heard what it is to hear; then says all that it heard."""


def write_package(packages: Path) -> Path:
    """Write the package ``latches`` of these nodes; returns the folder of its programs."""
    scripts = packages / "latches" / "scripts"
    scripts.mkdir(parents=True)
    scripts.parent.joinpath("package.xml").write_text("<package><name>latches</name></package>")
    for name, text in (("latcher.py", LATCHER), ("listener.py", LISTENER)):
        node = scripts / name
        node.write_text(text)
        node.chmod(0o755)
    return scripts


def say_map(text: str) -> str:
    """What a listener says of a map."""
    side = int(MAP_CELLS**0.5)
    return f"{text}:{side}x{side}:{MAP_CELLS}"


def wanted(**heard: list[str]) -> str:
    """What a listener says that heard this, by topic without the slash."""
    return ";".join(
        ["heard", *(f"/{topic}={','.join(sorted(found))}" for topic, found in sorted(heard.items()))]
    )
