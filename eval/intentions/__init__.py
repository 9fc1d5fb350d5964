"""Do priors learned toward known goals predict another agent's goal?"""
