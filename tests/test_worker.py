"""What goes wrong in another process is told in one way, wherever it was asked for."""

from __future__ import annotations

import multiprocessing
import pickle
from multiprocessing.connection import Connection

import pytest
import torch

from torchslam.errors import FrameError
from torchslam.worker import READY, attempt, outcome, questions, reply, serve, task


def fail(error: Exception) -> None:
    raise error


def test_an_answer_is_itself_and_is_found_in_inference_mode() -> None:
    assert outcome(attempt("adds", lambda a, b: a + b, 1, 2)) == 3
    assert attempt("looks", torch.is_inference_mode_enabled) is True


def test_an_error_is_raised_where_it_is_wanted_with_where_it_was() -> None:
    answer = pickle.loads(pickle.dumps(attempt("reads ahead", fail, ZeroDivisionError("what is this?"))))
    with pytest.raises(ZeroDivisionError, match="what is this") as raised:
        outcome(answer)
    (note,) = raised.value.__notes__
    assert note.startswith("in the process that reads ahead:\nTraceback")
    assert "in fail" in note


def test_errors_of_our_own_say_all_by_themselves() -> None:
    with pytest.raises(FrameError) as raised:
        outcome(attempt("reads ahead", fail, FrameError("frame 3 is damaged")))
    assert not hasattr(raised.value, "__notes__")


def test_work_begins_with_its_task_and_ends_with_the_one_that_asks() -> None:
    ours, theirs = multiprocessing.Pipe()
    ours.send_bytes(task("twice", 2))
    for number in (3, 4):
        ours.send_bytes(pickle.dumps(number))
    heard: list[object] = []

    def work(connection: Connection, name: str, factor: int) -> None:
        heard.append(ours.recv_bytes())
        for number in questions(connection):
            reply(connection, (name, factor * number))
            heard.append(pickle.loads(ours.recv_bytes()))
            if number == 4:
                ours.close()

    serve(work, theirs)
    assert heard == [READY, ("twice", 6), ("twice", 8)]
