"""Evaluate active visual localization on recordings: which way should the robot look to know where it is?"""

__version__ = "0.1.0"
