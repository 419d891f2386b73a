"""The columns of a file of three gyros and three accelerometers."""

SIX = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
HEADER = ("gyro_x [deg/s]", "gyro_y [deg/s]", "gyro_z [deg/s]", "accel_x [g]", "accel_y [g]", "accel_z [g]")
#: What a reader is told of a file without a header.
UNITS = {"gyro_unit": "deg/s", "accel_unit": "g"}
