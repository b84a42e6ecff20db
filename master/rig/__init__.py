"""A rig and its files: a calibration folder enters, checked setups leave."""
