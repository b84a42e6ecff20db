"""The estimator: pixels of all sensors enter, one hand with covariance leaves."""
