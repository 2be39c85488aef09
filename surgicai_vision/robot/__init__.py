"""The robot: the CRTK interface of the da Vinci Research Kit, as server and as client.

`robot serve` makes the simulation a dVRK that any CRTK client may drive; `robot drive` makes a
policy a client of a dVRK, simulated or real. The interface follows the contract of JHU's simulators
(jhu-dvrk/dvrk_simulator_base, docs/ros_crtk_contract.md). Where the contract is silent, it follows
their source files, which are cited in place.

These modules use no ROS and are tested without it: `messages` (what is sent), `topics` (names),
`operating_state`, `trajectory`, `frames` and `arm` (what a command does), `server` (a dVRK's loop),
`guards` and `driver` (a client's loop). A transport carries the messages (`transport`): `dds`
speaks DDS as ROS 2 does, through cyclonedds, with no ROS installed.
"""
