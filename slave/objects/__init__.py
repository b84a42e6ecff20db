"""Devices that track themselves: a driver enters, poses with times leave."""
