"""The processes that convert large messages: when the pool ends, none is left, whatever it was doing."""

from __future__ import annotations

import asyncio

import psutil
import pytest
from support.engine import until

from rce_robot.conversion.jobs import ReadText
from rce_robot.conversion.pool import ConversionPool, ConversionSettings

STRING = "std_msgs/String"
JOB = ReadText(i_tag="tag", stated_type=STRING, message_type="SubscriberConverter", interface_type=STRING)
PARTS = [b'{"data":"hello"}']


def workers() -> list[psutil.Process]:
    return psutil.Process().children()


@pytest.mark.parametrize("turns", range(4))
async def test_closing_while_an_idle_process_is_retired_leaves_none(turns: int) -> None:
    pool = ConversionPool(settings=ConversionSettings(idle=0.0))
    await pool.convert("user", JOB, PARTS)
    for _ in range(turns):
        await asyncio.sleep(0)
    await pool.close()
    assert workers() == []


async def test_closing_while_a_process_starts_leaves_none() -> None:
    pool = ConversionPool()
    converting = asyncio.create_task(pool.convert("user", JOB, PARTS))
    await until(workers, what="the process is there")
    await pool.close()
    await asyncio.wait([converting])
    assert converting.exception() is not None
    assert workers() == []
