"""Writes the Grafana dashboard to stdout; `make dashboard` puts it where Grafana is told to look."""

from __future__ import annotations

from grafana_foundation_sdk.builders import common, dashboard, prometheus, stat, timeseries, trend
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.common import LegendDisplayMode, LegendPlacement
from grafana_foundation_sdk.models.dashboard import DataSourceRef, DataTransformerConfig, DynamicConfigValue

SOURCE = DataSourceRef(type_val="prometheus", uid="prometheus")
COLUMNS = 24
OTHER_FIGURES = 'name!~"reward_ratio|eta_gradient_norm|.*_s"'


def query(expression: str, legend: str, ref_id: str) -> prometheus.Dataquery:
    """One line of a panel."""
    return (
        prometheus.Dataquery()
        .expr(expression)
        .legend_format(legend)
        .ref_id(ref_id)
        .range()
        .datasource(SOURCE)
    )


def legend() -> common.VizLegendOptions:
    """The names of the lines, below them."""
    return (
        common.VizLegendOptions()
        .display_mode(LegendDisplayMode.LIST)
        .placement(LegendPlacement.BOTTOM)
        .show_legend(True)
    )


def series(
    title: str, description: str, unit: str, *queries: tuple[str, str], width: int = 8
) -> timeseries.Panel:
    """Figures against time; each query is an expression and the legend of its lines."""
    panel = timeseries.Panel().legend(legend()).fill_opacity(8)
    for number, (expression, name) in enumerate(queries):
        panel.with_target(query(expression, name, chr(ord("A") + number)))
    return panel.title(title).description(description).unit(unit).datasource(SOURCE).span(width).height(8)


def figure(title: str, description: str, unit: str, expression: str) -> stat.Panel:
    """The newest value of one figure."""
    return (
        stat.Panel()
        .with_target(query(expression, "", "A"))
        .title(title)
        .description(description)
        .unit(unit)
        .datasource(SOURCE)
        .span(COLUMNS // 6)
        .height(4)
    )


def win_rate_against_steps() -> trend.Panel:
    """The paper's curve: the two series are joined on time, then drawn against the one that only grows.

    Grafana draws nothing against figures that repeat, so the steps are there only where they have changed,
    be it while the learner was gone.
    """
    before = "last_over_time(liir_evaluated_env_steps[$__range] offset $__interval)"
    return (
        trend.Panel()
        .legend(legend())
        .with_target(query(f"max(liir_evaluated_env_steps != {before})", "environment steps", "A"))
        .with_target(query("max by (map, actions) (liir_win_rate)", "{{map}} {{actions}}", "B"))
        .with_transformation(
            DataTransformerConfig("joinByField", options={"byField": "Time", "mode": "inner"})
        )
        .with_transformation(DataTransformerConfig("organize", options={"excludeByName": {"Time": True}}))
        .x_field("environment steps")
        .title("Win rate against environment steps")
        .description("Wins / episodes of each tested checkpoint. Choose a time range that shows one run.")
        # The range is of the win rates alone: the other axis would end at 1, too.
        .unit("short")
        .override_by_regexp(
            "/greedy|sampled/",
            [
                DynamicConfigValue("unit", "percentunit"),
                DynamicConfigValue("min", 0),
                DynamicConfigValue("max", 1),
            ],
        )
        .datasource(SOURCE)
        .span(12)
        .height(9)
    )


def build() -> dashboard.Dashboard:
    """The dashboard, row by row."""
    board = (
        dashboard.Dashboard("LIIR")
        .uid("liir")
        .tags(["liir"])
        .refresh("5s")
        .time("now-30m", "now")
        .tooltip(1)  # one crosshair through all panels
    )
    rows = {
        "Now": [
            figure(
                "Progress", "Environment steps done of those wanted.", "percentunit", "liir:progress:ratio"
            ),
            figure("Environment steps", "Of the whole run, resumed or not.", "short", "liir_run_env_steps"),
            figure(
                "Environment steps wanted", "The run is complete then.", "short", "liir_run_wanted_env_steps"
            ),
            figure("Learner step", "Which is the policy version.", "short", "liir_learner_step"),
            figure("Checkpoint age", "Since the newest was frozen.", "s", "liir:checkpoint_age_seconds"),
            figure(
                "Evaluation backlog",
                "Checkpoints that wait for their test.",
                "short",
                "liir:evaluation_backlog",
            ),
        ],
        "Learning": [
            win_rate_against_steps(),
            series(
                "Win rate",
                "The same against time; greedy takes the best action, sampled draws from the policy.",
                "percentunit",
                ("max by (map, actions) (liir_win_rate)", "{{map}} {{actions}}"),
                width=12,
            )
            .min(0)
            .max(1),
            series(
                "Return",
                "Mean extrinsic return of an episode: of the newest batch, and of the newest test.",
                "short",
                ("liir_episode_return", "training"),
                ("liir_evaluation_return", "test, {{actions}}"),
            ),
            series(
                "Intrinsic / extrinsic",
                "Mean |λ r_in| / mean |r_ex|; above 1 the team trains on its own reward.",
                "short",
                ('liir_training_metric{name="reward_ratio"}', "ratio"),
            ).min(0),
            series(
                "‖∇η‖",
                "Norm of the meta-gradient; 0 means that the intrinsic reward no longer learns.",
                "sci",
                ('liir_training_metric{name="eta_gradient_norm"}', "‖∇η‖"),
            ),
            series(
                "Other figures of the update",
                "As in metrics.csv.",
                "short",
                (f"liir_training_metric{{{OTHER_FIGURES}}}", "{{name}}"),
                width=16,
            ),
            series(
                "Episode length", "Of the newest batch.", "short", ("liir_episode_length_steps", "steps")
            ).min(0),
        ],
        "Throughput": [
            series(
                "Environment steps per second",
                "Consumed by the learner.",
                "short",
                ("liir:env_steps:rate1m", "{{map}}"),
            ).min(0),
            series(
                "Episodes per second",
                "Consumed by the learner; tests are played beside them.",
                "short",
                ("sum by (map) (rate(liir_episodes_total[$__rate_interval]))", "{{map}}"),
                (
                    "sum by (actions) (rate(liir_evaluation_episodes_total[$__rate_interval]))",
                    "test, {{actions}}",
                ),
            ).min(0),
            series(
                "Learner phases",
                "Share of the time: collect waits for actors, update learns, record writes.",
                "percentunit",
                ("liir:learner_phase:ratio", "{{phase}}"),
            )
            .min(0)
            .max(1),
            series(
                "Seconds of a phase, 95 %",
                "Of one learner step.",
                "s",
                (
                    "histogram_quantile(0.95, sum by (phase, le) "
                    "(rate(liir_learner_phase_seconds_bucket[$__rate_interval])))",
                    "{{phase}}",
                ),
            ).min(0),
            series(
                "Policy lag",
                "Versions between the newest policy and the one that played the batch.",
                "short",
                ("liir_policy_lag_versions", "versions"),
            ).min(0),
            series(
                "Queue",
                "Tickets with actors, and complete batches that wait for the learner.",
                "short",
                ("liir_tickets_outstanding", "tickets"),
                ("liir_batches_waiting", "batches"),
            ).min(0),
            series(
                "Actors' waiting",
                "Share of their time. Near 1 is usual for short games: many actors, little to play.",
                "percentunit",
                ("liir:actor_wait:ratio", "waiting"),
            )
            .min(0)
            .max(1),
            series(
                "Trajectories received",
                "Bytes on the actors' streams.",
                "Bps",
                ("rate(liir_trajectory_bytes_total[$__rate_interval])", "received"),
            ).min(0),
            series(
                "Evaluation time",
                "Mean seconds to test one checkpoint.",
                "s",
                (
                    "rate(liir_evaluation_seconds_sum[$__rate_interval])"
                    " / rate(liir_evaluation_seconds_count[$__rate_interval])",
                    "test",
                ),
            ).min(0),
        ],
        "Checkpoints": [
            series(
                "Checkpoint age", "Since the newest was frozen.", "s", ("liir:checkpoint_age_seconds", "age")
            ).min(0),
            series(
                "Frozen and tested",
                "The gap is the backlog; the section checkpoints of the configuration has old ones deleted.",
                "short",
                ("liir_checkpoints", "frozen"),
                ("liir_evaluations", "tested"),
                ("liir_checkpoints_deleted", "deleted"),
                ("liir_checkpoints_damaged", "damaged"),
            ).min(0),
            series(
                "Evaluator's position",
                "Episode of the checkpoint tested last.",
                "short",
                ("liir_evaluator_position_episode", "episode"),
            ).min(0),
        ],
        "Health": [
            series("Up", "1 while a process answers.", "short", ("up", "{{job}}")).min(0).max(1),
            series("Disk full", "1 while the run waits for room.", "short", ("liir_disk_full", "full"))
            .min(0)
            .max(1),
            series(
                "Actors",
                "Streams at the learner, Ray actors running, and those that should.",
                "short",
                ("liir_actors_connected", "connected"),
                ("liir_driver_actors_alive", "alive"),
                ("liir_driver_actors_wanted", "wanted"),
            ).min(0),
            series(
                "Actor restarts and repeated work",
                "Within 5 minutes. A ticket goes to another actor when its first is gone or late.",
                "short",
                ("increase(liir_driver_actor_restarts_total[5m])", "restarts"),
                ("increase(liir_tickets_reissued_total[5m])", "tickets again, {{reason}}"),
                ("increase(liir_duplicate_trajectories_total[5m])", "duplicates"),
            ).min(0),
            series(
                "RPC errors",
                "Calls that failed per second.",
                "short",
                (
                    "sum by (method, code) (rate(liir_rpc_errors_total[$__rate_interval])) or vector(0)",
                    "{{method}} {{code}}",
                ),
            ).min(0),
            series(
                "Memory",
                "Resident, per process; of the actors the sum of their peaks, shared pages counted by each.",
                "bytes",
                ("process_resident_memory_bytes", "{{job}}"),
                ("compute_process_resident_memory_bytes", "{{job}}, computing"),
                ("liir_actor_peak_memory_bytes", "all actors, peak"),
            ).min(0),
            series(
                "CPU",
                "Cores in use, per process.",
                "short",
                ("rate(process_cpu_seconds_total[$__rate_interval])", "{{job}}"),
                ("rate(compute_process_cpu_seconds_total[$__rate_interval])", "{{job}}, computing"),
            ).min(0),
            series(
                "Open descriptors",
                "Files and connections, per process; level while nothing leaks.",
                "short",
                ("process_open_fds", "{{job}}"),
                ("compute_process_open_fds", "{{job}}, computing"),
            ).min(0),
        ],
    }
    for title, panels in rows.items():
        board.with_row(dashboard.Row(title))
        for panel in panels:
            board.with_panel(panel)
    return board


if __name__ == "__main__":
    print(JSONEncoder(sort_keys=True, indent=1, ensure_ascii=False).encode(build().build()))
