"""Friction identification: data, the models of (11), particle swarm, variable projection, intervals, report.

One direction at a time, mirrored to positive speed u [joint rad/s] and positive friction [motor Nm], as in
`firmware_py.friction`.
"""
