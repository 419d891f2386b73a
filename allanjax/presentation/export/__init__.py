"""Fitted noise as the configuration files of estimators, autopilots and simulators."""
