function [frames, record] = sci(meas, mask, config, varargin)
%SCI Video from snapshot compressive measurements, by the sci command, which must be on the path.
%   frames = SCI(meas, mask) reconstructs the frames [H, W, N*T] of measurements meas [H, W, N] through masks mask [H, W, T]; white
%   is 255. Of color sensors they are [H, W, 3, N*T].
%   frames = SCI(meas, mask, 'gray/refined', 'denoiser.dim=2', ...) takes another experiment, a file or a name, and settings of it.
%   [frames, record] = SCI(...) also gives what record.json says: quality, seconds, iterations of each measurement.
if nargin < 3, config = 'gray/default'; end
folder = tempname; mkdir(folder);
cleaner = onCleanup(@() rmdir(folder, 's'));
scene = fullfile(folder, 'scene.mat'); out = fullfile(folder, 'run');
save(scene, 'meas', 'mask', '-v7');
settings = [{['data.path=' scene], 'output={format="mat",frames=false,preview=false,report=false}'}, varargin];
if ispc, quoted = @(s) ['"' strrep(s, '"', '\"') '"']; else, quoted = @(s) ['''' strrep(s, '''', '''\''''') '''']; end
settings = cellfun(@(s) [' --set ' quoted(s)], settings, 'UniformOutput', false);
[status, said] = system(['sci run ' quoted(config) ' --out ' quoted(out) settings{:} ' 2>&1']);
if status ~= 0, error('sci:failed', '%s', said); end
result = load(fullfile(out, 'recon.mat')); frames = result.recon;
if nargout > 1, record = jsondecode(fileread(fullfile(out, 'record.json'))); end
end
