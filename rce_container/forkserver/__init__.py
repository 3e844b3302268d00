"""The fork server: has imported all modules of an environment, and forks one for each container.

A container's namespaces are made by bubblewrap around a *holder*, a shell that waits. The fork server's child
joins them, drops all privileges, and becomes the container's environment: no interpreter starts, and no
module is imported.
"""
