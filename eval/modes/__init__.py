"""How many hidden modes have the mice, which come back, and where do they lead?"""
