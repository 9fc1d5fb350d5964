"""Are several priors that share a planner's candidates nowhere behind the best of them alone?"""
