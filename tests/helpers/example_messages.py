"""One message of every kind that travels between a robot and its clients."""

from surgicai_vision.robot import messages as m

HEADER = m.Header(1_795_000_000_123_456_789, "ECM_view")
EXAMPLES = [
    m.JointState(HEADER, ("yaw", "pitch"), (0.1, -0.2), (0.0, 1e-9), ()),
    m.PoseStamped(HEADER, (0.1, 0.2, 0.3), (0.0, 0.6, 0.0, 0.8)),
    m.TwistStamped(HEADER, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0)),
    m.OperatingState(HEADER, "ENABLED", True, False),
    m.StringStamped(HEADER, "clear_fault"),
    m.String("400006"),
    m.Image(HEADER, 2, 3, bytes(range(18))),
    m.CompressedImage(HEADER, "jpeg", b"\xff\xd8 and so on"),
    m.Joy(HEADER, (0.5, -1.0), (1, 0)),
    m.CameraInfo(HEADER, 2, 3, tuple(float(value) for value in range(9))),
]
