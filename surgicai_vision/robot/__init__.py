"""The robot: the CRTK interface of the da Vinci Research Kit, spoken both ways.

`robot serve` makes the simulation a dVRK that any CRTK client may drive; `robot drive` makes a
policy a client of a dVRK, simulated or real. The contract is that of JHU's simulators
(jhu-dvrk/dvrk_simulator_base, docs/ros_crtk_contract.md); where it is silent, its sources are
cited where they are followed.

What knows no ROS, and is tested without: `messages` (what travels), `topics` (what it is called),
`operating_state`, `trajectory`, `frames` and `arm` (what a command does), `server` (a dVRK's loop),
`guards` and `driver` (a client's). A transport carries the messages (`transport`): `dds` speaks
DDS as ROS 2 does, by cyclonedds, with no ROS installed.
"""
