"""Inertial data: rates and forces enter, orientations with covariance leave."""
