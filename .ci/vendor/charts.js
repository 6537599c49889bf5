// What the runs page takes of Apache ECharts: lines and parallel coordinates, on a canvas.
import { LineChart, ParallelChart } from "echarts/charts";
import {
  GridComponent, LegendComponent, ParallelComponent, TooltipComponent, VisualMapContinuousComponent,
} from "echarts/components";
import { init, use } from "echarts/core";
import { CanvasRenderer } from "echarts/renderers";

use([
  LineChart, ParallelChart, GridComponent, LegendComponent, ParallelComponent, TooltipComponent,
  VisualMapContinuousComponent, CanvasRenderer,
]);
export { init };
