"""Do priors learned toward known goals tell what another agent is after?"""
