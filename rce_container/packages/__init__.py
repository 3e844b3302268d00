"""Packages that users bring, on a machine of containers.

- :mod:`~rce_container.packages.cache` fetches, verifies and unpacks them, each once for all containers;
- :mod:`~rce_container.packages.shelf` puts them into a container's folder, while it runs;
- :mod:`~rce_container.packages.requirements` installs what their ``requirements.txt`` asks for;
- :mod:`~rce_container.packages.supply` does all of this for one container, and reports failures to its owner.
"""
