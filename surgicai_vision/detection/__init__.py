"""Detection: where a camera's image shows the jaws of each arm.

A crop lies where the arm reports its jaws and the nominal calibration projects them. With cameras
or joints off by a few millimetres it misses them. A detector finds the jaws in the camera's whole
image instead, and `evaluation.aimed_agent` cuts the crop there.

* `examples`, `example_jobs`: recorded states → whole images with the jaws' true places;
* `network`, `detector`: the network, and the trained detector in its folder;
* `fit`: examples → detector.
"""
