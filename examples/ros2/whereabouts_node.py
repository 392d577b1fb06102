"""A ROS 2 node that localizes a camera: a thin wrapper around `localizer`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String

from localizer import (
    Localizer,
    Odometer,
    PoseWithCovariance,
    Shot,
    Spread,
    Wishes,
    encode,
    instant,
    origin_of,
)
from whereabouts_client import Whereabouts

REPORT_EVERY_S = 60.0


class WhereaboutsNode(Node):
    def __init__(self) -> None:
        super().__init__("whereabouts")
        number = {
            name: self.declare_parameter(name, default).value
            for name, default in {
                "k": 10,
                "deadline_ms": 2000,
                "job_timeout_s": 60.0,
                "origin_lat": math.nan,
                "origin_lon": math.nan,
                "origin_alt": math.nan,
                "place_sigma_m": Spread.place_m,
                "turn_sigma_rad": Spread.turn_rad,
                "similarity_scale": Spread.similarity_scale,
            }.items()
        }
        self._frame_id = self.declare_parameter("frame_id", "map").value
        wishes = Wishes(
            map=self.declare_parameter("map", "town").value,
            k=number["k"],
            refine=self.declare_parameter("refine", True).value,
            deadline_ms=number["deadline_ms"],
            job_timeout_s=number["job_timeout_s"],
            only_known=self.declare_parameter("only_known", True).value,
            origin=origin_of(number["origin_lat"], number["origin_lon"], number["origin_alt"]),
            spread=Spread(number["place_sigma_m"], number["turn_sigma_rad"], number["similarity_scale"]),
            track=self.declare_parameter("track", "").value or None,
        )
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._refined_pose = self.create_publisher(PoseWithCovarianceStamped, "~/refined_pose", 10)
        self._track_pose = self.create_publisher(PoseWithCovarianceStamped, "~/track_pose", 10)
        self._job = self.create_publisher(String, "~/job", 10)
        # The API key is not a ROS parameter, because parameters are readable by every node.
        self._service = Whereabouts(
            self.declare_parameter("server_url", "http://localhost:8080").value,
            api_key=os.environ.get("WHEREABOUTS_API_KEY"),
            timeout_s=wishes.deadline_ms / 1000 + 3,
        )
        self._odometer = Odometer()
        self._localizer: Localizer[Time] = Localizer(self._service, wishes, self, self._odometer)
        odometry_topic = self.declare_parameter("odometry_topic", "").value
        if odometry_topic and wishes.track:
            self.create_subscription(Odometry, odometry_topic, self._odometry, qos_profile_sensor_data)
        if self.declare_parameter("image_transport", "compressed").value == "raw":
            self.create_subscription(Image, "image", self._raw, qos_profile_sensor_data)
        else:
            self.create_subscription(
                CompressedImage, "image/compressed", self._compressed, qos_profile_sensor_data
            )
        self.create_timer(REPORT_EVERY_S, self._report)

    def close(self) -> None:
        self._localizer.close()
        self._service.close()

    def _compressed(self, message: CompressedImage) -> None:
        self._offer(message.header.stamp, lambda: bytes(message.data))

    def _raw(self, message: Image) -> None:
        def jpeg() -> bytes:
            size = (message.width, message.height, message.step)
            return encode(message.encoding, *size, bytes(message.data))

        self._offer(message.header.stamp, jpeg)

    def _offer(self, stamp: Time, picture: Callable[[], bytes]) -> None:
        self._localizer.offer(Shot(stamp, picture, instant(stamp.sec, stamp.nanosec)))

    def _odometry(self, message: Odometry) -> None:
        at = instant(message.header.stamp.sec, message.header.stamp.nanosec)
        position, turn = message.pose.pose.position, message.pose.pose.orientation
        if at:
            orientation = (turn.x, turn.y, turn.z, turn.w)
            self._odometer.add(at, (position.x, position.y, position.z), orientation)

    def _report(self) -> None:
        at = self._localizer
        self.get_logger().info(
            f"{at.posted} frames posted, {at.dropped} dropped in favour of newer ones; "
            f"{at.unfollowed} jobs not followed because of newer ones"
        )

    # Callbacks of the localizer, called from its own threads.

    def coarse(self, stamp: Time, pose: PoseWithCovariance) -> None:
        self._pose.publish(self._message(stamp, pose))

    def refined(self, stamp: Time, pose: PoseWithCovariance) -> None:
        self._refined_pose.publish(self._message(stamp, pose))

    def tracked(self, stamp: Time, pose: PoseWithCovariance) -> None:
        self._track_pose.publish(self._message(stamp, pose))

    def job(self, text: str) -> None:
        self._job.publish(String(data=text))

    def trouble(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _message(self, stamp: Time, pose: PoseWithCovariance) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped()
        message.header.stamp = stamp
        message.header.frame_id = self._frame_id
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        position.x, position.y, position.z = pose.position
        orientation.x, orientation.y, orientation.z, orientation.w = pose.orientation
        message.pose.covariance = list(pose.covariance)
        return message


def main() -> None:
    rclpy.init()
    node = WhereaboutsNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
