"""What an attacker and bad luck found, and the tests that hold it.

Whatever is in none of them is mutated by the campaign (``test_mutated_inputs.py``: every kind of input, ever anew).
``gpvo check`` exits with 1 by design: a model that does not fit is an answer, not a failure.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

HERE = Path(__file__).parent
FINDINGS = {
    "1 code injection by a model": (
        "test_model_files: no_text_of_a_model_becomes_c_code, a_prefix_is_a_c_identifier_and_no_keyword",
    ),
    "2 one bad stamp kills the predictor": (
        "test_records: a_bad_record_is_lost_by_name_and_the_next_good_one_heals,"
        " a_clock_that_was_set_is_believed_at_the_second_record,"
        " any_row_is_answered_with_a_positive_definite_covariance",
    ),
    "3 everything missing looks sure": (
        "test_records: a_row_without_its_inputs_is_no_surer_than_the_worst_of_training,"
        " a_record_of_which_nothing_is_known_is_not_ok,"
        " one_missing_input_that_training_never_missed_is_not_in_the_domain",
        "../publish/test_export: onnx_runs_to_the_same_numbers, c_compiles_to_the_same_numbers",
    ),
    "4 bombs of YAML, pictures, arrays": (
        "test_bombs: yaml_bombs_are_refused_at_once, the_size_is_read_from_the_header,"
        " an_image_that_claims_a_quarter_of_a_gigapixel_is_not_decoded,"
        " a_chunk_that_claims_gigabytes_is_not_made_room_for,"
        " a_sequence_of_such_images_is_refused_by_its_calibration, an_array_that_nobody_needs_is_not_unpacked,"
        " an_array_that_is_needed_is_not_unpacked_beyond_all_tracks, a_table_of_run_lengths_is_refused,"
        " a_pipe_without_an_end_is_left_at_its_bound",
    ),
    "5 faults of the IMU": (
        "test_imu_faults: a_momentary_fault_costs_little, the_filter_stays_consistent_after_a_fault,"
        " a_log_is_usable_but_for_its_faults",
    ),
    "6 a model's arrays": (
        "test_model_files: arrays_against_the_schema_are_refused, headers_against_the_schema_are_refused,"
        " numbers_beyond_all_floats_are_refused, every_array_of_a_model_has_a_line_in_the_schema",
    ),
    "7 indefinite covariances in a run": (
        "test_runs: a_covariance_that_is_none_is_refused, a_prediction_that_is_none_is_refused,"
        " the_writer_leaves_out_what_is_no_covariance",
    ),
    "8 terminal escapes": (
        "test_runs: nothing_of_a_file_reaches_the_terminal_as_a_command,"
        " names_inside_a_bag_reach_neither_terminal_nor_run_raw,"
        " a_warning_reaches_the_terminal_as_text, a_file_named_to_fool_the_terminal_is_refused",
        "test_model_files: no_text_of_a_model_is_obeyed_by_a_terminal",
    ),
    "9 a finished run is lost": (
        "test_runs: a_finished_run_stays_until_the_new_one_is_whole, what_a_broken_run_left_is_replaced_without_asking,"
        " the_command_replaces_a_finished_run_only_when_told",
        "../kills/test_kills: replacements, a_full_disk_costs_one_line_and_leaves_what_was_there",
    ),
    "10 tracebacks": (
        "test_bombs: tracks_that_cannot_be_are_refused, damaged_array_headers_are_refused,"
        " lengths_that_are_none_in_an_mcap_are_refused, yaml_bombs_are_refused_at_once,"
        " a_position_beyond_the_earth_is_refused, a_rate_that_is_none_is_refused,"
        " text_in_the_place_of_numbers_is_refused, json_numbers_beyond_all_floats_are_refused",
    ),
    "11 lesser ones": (
        "test_bombs: tracks_that_cannot_be_are_refused, a_line_without_end_is_not_read_whole",
        "test_runs: a_full_disk_names_the_file_and_leaves_nothing_half_written, two_writers_do_not_mix",
        "test_imu_faults: a_flight_that_goes_nowhere_has_no_drift_per_distance,"
        " a_record_far_ahead_is_left_out_and_the_next_is_used",
        "../filters/test_timeline: a_record_far_ahead_is_left_out_until_the_next_agrees",
        "test_records: a_camera_that_cannot_be_is_refused, another_camera_than_that_of_training_is_told,"
        " a_picture_that_is_none_of_the_camera_is_refused_by_its_shape",
    ),
    "a killed run begins anew": ("../kills/test_resume: the_same_bytes_after_breaking_off_twice",),
    "what is kept of a run or a session": (
        "../kills/test_resume: a_state_that_cannot_be_is_refused_in_one_line,"
        " chunks_with_motions_that_cannot_be_are_not_gone_on_with",
        "test_runs: a_mounting_beyond_all_measure_is_refused_without_a_warning",
        "../io/test_snapshot: numbers_beyond_all_measure_are_not_taken_up",
        "../live/test_engine: a_state_that_cannot_be_is_refused_in_one_line",
    ),
}


@pytest.mark.parametrize("finding", FINDINGS)
def test_every_finding_has_its_tests(finding: str) -> None:
    for told in FINDINGS[finding]:
        file, _, names = told.partition(": ")
        tree = ast.parse((HERE / f"{file}.py").read_text())
        there = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert {f"test_{name.strip()}" for name in names.split(",")} <= there
