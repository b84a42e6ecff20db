"""Laser and LEDs: a strobe schedule enters, pulses within safe limits leave."""
