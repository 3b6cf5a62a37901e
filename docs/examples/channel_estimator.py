"""Your channel estimator as a node: each line of standard input is a snapshot, written as JSON.

{"speed": 22.2, "turn_rate": 0.31, "paths": [[delay_s, azimuth, elevation, doppler], ...]}
"""

import json
import math
import sys

import rclpy
from dopslam_msgs.msg import ChannelMeasurement, ChannelMeasurementSet
from geometry_msgs.msg import TwistStamped
from rclpy.duration import Duration
from rclpy.node import Node


class ChannelEstimator(Node):
    def __init__(self) -> None:
        super().__init__("channel_estimator")
        self.controls = self.create_publisher(TwistStamped, "odometry_control", 100)
        self.sets = self.create_publisher(ChannelMeasurementSet, "channel_measurements", 100)

    def publish(self, speed: float, turn_rate: float, paths: list[list[float]]) -> None:
        control, snapshot = TwistStamped(), ChannelMeasurementSet()
        control.header.stamp = snapshot.header.stamp = self.get_clock().now().to_msg()
        control.header.frame_id = snapshot.header.frame_id = "base_link"
        control.twist.linear.x, control.twist.angular.z = speed, turn_rate  # from now on
        for delay, azimuth, elevation, doppler in paths:
            path = ChannelMeasurement(snr_db=math.nan)
            path.path_length = delay * 299792458.0  # metres, with the clock bias in it
            path.aoa_azimuth, path.aoa_elevation = azimuth, elevation  # seen from the vehicle
            path.aod_azimuth = path.aod_elevation = math.nan  # not measured: NaN, never zero
            path.doppler = doppler  # m/s, positive when approaching
            snapshot.paths.append(path)  # covariance zero: the filter's measurement_noise_std
        self.controls.publish(control)  # the control first
        self.sets.publish(snapshot)


rclpy.init()
node = ChannelEstimator()
while node.controls.get_subscription_count() == 0 or node.sets.get_subscription_count() == 0:
    rclpy.spin_once(node, timeout_sec=0.1)
for line in sys.stdin:
    node.publish(**json.loads(line))
for publisher in (node.controls, node.sets):
    publisher.wait_for_all_acked(Duration(seconds=5))
node.destroy_node()
rclpy.shutdown()
