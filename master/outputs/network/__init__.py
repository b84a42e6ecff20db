"""Network outputs: hands of the bus enter, OSC, VMC, LSL and ROS 2 leave."""
