"""Do modes as options help a planner that samples?"""
