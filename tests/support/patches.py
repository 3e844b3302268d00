"""Patches between specs that a test has as wholes."""

from __future__ import annotations

from msgspec.structs import replace

from rce.control.model import EndpointContents, EndpointSpec, SpecPatch


def patch_between(old: EndpointSpec, new: EndpointSpec) -> SpecPatch:
    """Build the patch that leads from one spec to another."""
    contents = EndpointContents(
        resources=new.resources, nodes=new.nodes, parameters=new.parameters, packages=new.packages
    )
    had = EndpointContents(
        resources=old.resources, nodes=old.nodes, parameters=old.parameters, packages=old.packages
    )
    return SpecPatch(
        id=new.id,
        base=old.revision,
        revision=new.revision,
        interfaces=tuple(one for one in new.interfaces if one not in old.interfaces),
        links=tuple(one for one in new.links if one not in old.links),
        connections=tuple(one for one in new.connections if one not in old.connections),
        removed_interfaces=tuple({o.tag for o in old.interfaces} - {o.tag for o in new.interfaces}),
        removed_links=tuple({o.id for o in old.links} - {o.id for o in new.links}),
        removed_connections=tuple({o.id for o in old.connections} - {o.id for o in new.connections}),
        contents=contents if contents != had else None,
    )


def in_order(whole: EndpointSpec) -> EndpointSpec:
    """Return a spec with its parts sorted."""
    return replace(
        whole,
        interfaces=tuple(sorted(whole.interfaces, key=lambda one: one.tag)),
        links=tuple(sorted(whole.links, key=lambda one: one.id)),
        connections=tuple(sorted(whole.connections, key=lambda one: one.id)),
    )
