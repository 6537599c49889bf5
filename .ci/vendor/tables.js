// What the runs page takes of Tabulator.
import {
  FilterModule, FormatModule, InteractionModule, PageModule, ResizeColumnsModule, ResizeTableModule,
  ResponsiveLayoutModule, SelectRowModule, SortModule, Tabulator, TooltipModule,
} from "tabulator-tables";

Tabulator.registerModule([
  FilterModule, FormatModule, InteractionModule, PageModule, ResizeColumnsModule, ResizeTableModule,
  ResponsiveLayoutModule, SelectRowModule, SortModule, TooltipModule,
]);
export { Tabulator };
