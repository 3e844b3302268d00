"""The fleet manager: answers requests of the API from the book of tasks.

It writes the journal, and brings goals, modes, zones and blocked cells to the planner.
"""
