"""The ROS 2 message types that are read and written: names and definitions, the same in every distribution.

What a message's bytes hold follows from its type's name alone: ROS 2 itself goes by the type it was built with. The
definition that a recording carries along is for programs that do not know the type, and may be missing or damaged.
"""

from __future__ import annotations

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# Read, never written.
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TRANSFORM = "geometry_msgs/msg/Transform"
STRING = "std_msgs/msg/String"
FLOAT32 = "std_msgs/msg/Float32"

_RULE = "=" * 80
_HEADER = f"""
{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
DEFINITIONS = {
    POINT_CLOUD: f"""std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
{_RULE}
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count{_HEADER}""",
    IMAGE: f"""std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data{_HEADER}""",
    COMPRESSED_IMAGE: f"""std_msgs/Header header
string format
uint8[] data{_HEADER}""",
    CAMERA_INFO: f"""std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
{_RULE}
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify{_HEADER}""",
}
