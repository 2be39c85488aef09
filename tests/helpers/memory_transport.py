"""An in-process transport: every publisher reaches every inbox of its topic, in order."""

from collections import defaultdict

from surgicai_vision.robot.topics import EVENT, LATCHED
from surgicai_vision.robot.transport import Received


class Medium:
    """The state that several transports of one process share."""

    def __init__(self):
        self.inboxes = defaultdict(list)
        self.kept = {}  # messages that later subscribers receive too
        self.count = 0


class MemoryTransport:
    """A `Transport` whose messages stay in this process."""

    def __init__(self, medium=None, source="client"):
        self.medium = medium or Medium()
        self.source = source
        self.dropped = set()  # topics whose messages are lost

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return

    def publisher(self, topic):
        def publish(message):
            assert type(message) is topic.type
            if topic.name in self.dropped:
                return
            self.medium.count += 1
            received = Received(message, self.source, self.medium.count)
            if topic.quality in (EVENT, LATCHED):
                self.medium.kept[topic.name] = received
            for waiting in self.medium.inboxes[topic.name]:
                waiting.append(received)

        return publish

    def inbox(self, topic):
        waiting = [self.medium.kept[topic.name]] if topic.name in self.medium.kept else []
        self.medium.inboxes[topic.name].append(waiting)

        def take():
            taken = list(waiting)
            waiting.clear()
            return taken

        return take

    def listeners(self, topic):
        return len(self.medium.inboxes[topic.name])

    def wait(self, seconds):
        return
