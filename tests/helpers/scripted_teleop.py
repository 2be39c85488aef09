"""A LeRobot teleoperator that plays actions."""

from dataclasses import dataclass, field

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig


@TeleoperatorConfig.register_subclass("scripted")
@dataclass(kw_only=True)
class ScriptedConfig(TeleoperatorConfig):
    """The actions' names, and their values, one row per action; the last row repeats."""

    names: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


class Scripted(Teleoperator):
    config_class = ScriptedConfig
    name = "scripted"

    def __init__(self, config):
        super().__init__(config)
        self.config = config
        self.place = 0
        self.is_open = False

    @property
    def action_features(self):
        return dict.fromkeys(self.config.names, float)

    @property
    def feedback_features(self):
        return {}

    @property
    def is_connected(self):
        return self.is_open

    @property
    def is_calibrated(self):
        return True

    def calibrate(self):
        pass

    def configure(self):
        pass

    def connect(self, calibrate=True):
        self.is_open = True

    def disconnect(self):
        self.is_open = False

    def send_feedback(self, feedback):
        pass

    def get_action(self):
        row = self.config.rows[min(self.place, len(self.config.rows) - 1)]
        self.place += 1
        return dict(zip(self.config.names, row, strict=True))
