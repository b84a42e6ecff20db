"""IMU drivers, one file each: a port enters, samples with times leave."""
