"""Kinematic model of the hand: file and angles enter, joints and surfaces leave."""
