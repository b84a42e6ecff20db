"""Names of the drivers as the help and the errors list them.

They are those behind `--camera`, `--imu`, `--tracker` and `--lights`.
"""

REAL_CAMERAS = "picamera2[:INDEX] | v4l2[:DEVICE]"
CAMERAS = f"{REAL_CAMERAS} | synthetic | replay:FOLDER"
REAL_IMUS = "ximu3:PORT[@BAUD] | lsm6dsox:BUS[:ADDRESS]"
IMUS = f"{REAL_IMUS} | synthetic"
REAL_TRACKERS = "openvr | survive | survive:FILE"
TRACKERS = f"{REAL_TRACKERS} | synthetic"
SWITCHED_LIGHTS = "gpio:CHIP:LASER,LED | i2c:BUS[:ADDRESS]"
LIGHTS = f"{SWITCHED_LIGHTS} | camera | external"
SCANS = ("auto", "full", "windows")
# The units of a table of an IMU, by what is measured; a test compares them with `common.imu.csv_columns`.
IMU_UNITS = {
    "time": ("s", "ms", "us", "ns"),
    "gyro": ("rad/s", "deg/s", "mdeg/s"),
    "accel": ("m/s^2", "g", "mg"),
    "mag": ("uT", "T", "mT", "nT", "gauss", "mgauss"),
}
