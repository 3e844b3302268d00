"""Chooses the form of a robot's interface, by its type and class."""

from __future__ import annotations

from rce.link import InterfaceError
from rce.model import Form as FormName
from rce.model import InterfaceSpec, InterfaceType, Role
from rce.ros.types import MessageType, TypeRegistry, TypesError
from rce_robot.converters import Converters
from rce_robot.forms import ConverterForm, Form, ForwarderForm


class FormFactory:
    """Makes the forms of interfaces; converters are shared by all interfaces of a message type."""

    def __init__(self, types: TypeRegistry, converters: Converters | None = None) -> None:
        self._types = types
        self._converters = converters or Converters()

    def pair(self, spec: InterfaceSpec, type_: InterfaceType) -> tuple[Form, Form]:
        """Return the forms from and to the robot.

        Raises:
            InterfaceError: The interface is not one of a robot, or its class is unknown.
        """
        if type_.form is FormName.INTERFACE:
            raise InterfaceError(f"{type_} is a container's; a robot has Converters and Forwarders")
        if type_.form is FormName.FORWARDER:
            form = ForwarderForm()
            return form, form
        inwards, outwards = self._resolve(spec, type_.role)
        return ConverterForm(self._converters.of(inwards)), ConverterForm(self._converters.of(outwards))

    def _resolve(self, spec: InterfaceSpec, role: Role) -> tuple[MessageType, MessageType]:
        """Return the message types from and to the robot."""
        try:
            if not role.is_service:
                message = self._types.message(spec.message_type)
                return message, message
            service = self._types.service(spec.message_type)
        except TypesError as error:
            raise InterfaceError(str(error)) from error
        if role is Role.SERVICE_PROVIDER:  # the robot asks
            return service.request, service.response
        return service.response, service.request
